"""Find the candidates that explain what an accepted effect does, beside all others that were found.

When an effect is accepted others are still missing, and rivals that are equivalent to it in the end
may be told apart by what these leave. Its columns and those of all candidates without shape are in
one set of Gram matrices at the final point: without the effect its errors come back, and a
candidate that takes them again is a rival.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from ....model.effects.base import Effect
from ..linearised.linearisation_point import WorkingPoint
from ..search_options import SearchOptions
from .backward_elimination import columns_of, removal_costs, without_effect
from .candidate_screening import regressed, told_apart
from .gauss_newton import Candidate, Fitted, Part, gather
from .prescreening import most_telling
from .regression import gains_beside, steadied
from .tested_candidate import Tried

_HALF = 0.5
"""Who explains less than this share of what the effect does, in the parts of records that tell most
of it, explains no more of it in all."""


def equivalents(
    point: WorkingPoint, effects: Sequence[Effect], records: Fitted, options: SearchOptions
) -> dict[str, tuple[Tried, ...]]:
    """Return, by identity of each effect of the point, the candidates that may replace it.

    The best come first, a few. Only candidates without shape are asked, and no free form.
    """
    placed = {p.effect.identity for p in point.placed}
    asked: list[Candidate] = [
        (e, ())
        for e in effects
        if not e.shape and e.identity not in placed and e.effect_class != "unknown"
    ]
    if not asked or not point.placed:
        return {}
    base = gather(point, records.train(point))
    costs = removal_costs(point, base)
    only = most_telling(base, np.array(costs), options.least_squares)
    if only:
        near: set[int] = set()
        for own, tried in _instead(point, asked, records, only):
            near |= {i for i, t in enumerate(tried) if t.gain > _HALF * own.gain}
        asked = [asked[i] for i in sorted(near)]
    if not asked:
        return {}
    found = {}
    for own, rivals in _instead(point, asked, records, None):
        equal = [
            t
            for t in rivals
            if np.isfinite(t.gain) and not told_apart(t, own, options, base.excess)
        ]
        equal.sort(key=lambda t: -t.gain)
        found[own.effect.identity] = tuple(equal[: options.most_effects])
    return found


def _instead(
    point: WorkingPoint,
    asked: Sequence[Candidate],
    records: Fitted,
    only: Sequence[Part] | None,
) -> Iterator[tuple[Tried, list[Tried]]]:
    """Yield each effect of the point with its gain, and the candidates in its place with theirs.

    They are of some records by number, or of all.
    """
    train = gather(point, records.train(point, asked, only))
    costs = removal_costs(point, train)
    for p, cost in zip(point.placed, costs, strict=True):
        without = without_effect(steadied(train), columns_of(point, p), p.amplitudes)
        own = Tried(p.effect, p.shape, float(cost.sum()), cost, p.amplitudes)
        rivals = (
            Tried(*asked[i], float(gain.sum()), gain, ())
            for i, gain in enumerate(gains_beside(without))
        )
        yield own, [regressed(without, i, t)[0] for i, t in enumerate(rivals)]
