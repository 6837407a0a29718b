"""Find the candidates that explain what an accepted effect does, beside all others that were found.

When an effect is accepted others are still missing, and rivals that are equivalent to it in the end
may be told apart by what these leave. Its columns and those of all candidates without shape are in
one set of Gram matrices at the final point: without the effect its errors come back, and a
candidate that takes them again is a rival.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ....model.effects.base import Effect
from ..linearised.linearisation_point import WorkingPoint
from .backward_elimination import removal_costs, without_effect
from .candidate_screening import Tried, regressed, width
from .fit_shortlisted_candidates import MOST_EQUALS, told_apart
from .gauss_newton import Candidate, Fitted, gather
from .regression import gains_beside, steadied


def equivalents(
    point: WorkingPoint, effects: Sequence[Effect], records: Fitted
) -> dict[str, tuple[Tried, ...]]:
    """Return, by identity of each effect of the point, the candidates that may replace it.

    The best come first, at most six. Only candidates without shape are asked, and no free form.
    """
    placed = {p.effect.identity for p in point.placed}
    asked: list[Candidate] = [
        (e, ())
        for e in effects
        if not e.shape and e.identity not in placed and e.effect_class != "unknown"
    ]
    if not asked or not point.placed:
        return {}
    train = gather(point, records.train(point, asked))
    at, found = len(point.parameters.names), {}
    for p, cost in zip(point.placed, removal_costs(point, train), strict=True):
        columns = list(range(at, at + width(p)))
        without = without_effect(steadied(train), columns, p.amplitudes)
        own = Tried(p.effect, p.shape, float(cost.sum()), cost, p.amplitudes, np.inf)
        rivals = [regressed(without, i, *candidate, gain) for i, (candidate, gain) in
                  enumerate(zip(asked, gains_beside(without), strict=True))]  # fmt: skip
        equal = [t for t in rivals if np.isfinite(t.gain) and not told_apart(t, own)]
        equal.sort(key=lambda t: -t.gain)
        found[p.effect.identity] = tuple(equal[:MOST_EQUALS])
        at += width(p)
    return found
