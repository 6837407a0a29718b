"""Choose the friction law of a DOF: laws exclude each other, and none is added to another one.

While friction is all that the errors hold, several laws explain it alike. So once one was accepted,
all others of that DOF are fitted in its place, and those that explain about as much with all
numbers of the model, before anything else is searched in what the first one left.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ....model.effects.base import Effect, Placed
from ....model.effects.friction import LAWS
from ..linearised.linearisation_point import WorkingPoint
from ..search_options import SearchOptions
from .backward_elimination import columns_of, without_effect
from .candidate_screening import regressed
from .effects_not_told_apart import Member, alike_along, in_place, not_told_apart
from .gauss_newton import Candidate, Fitted, gather
from .regression import gains_beside, steadied
from .tested_candidate import Records, Tried


def best_laws(
    point: WorkingPoint,
    taken: Tried,
    effects: Sequence[Effect],
    records: Records,
    options: SearchOptions,
) -> list[Member]:
    """Return the law of friction that fits best in the place of an accepted one.

    Laws that the blocks do not tell from it follow. If the accepted effect is no law of friction,
    it is the only one.
    """
    own = taken.effect
    laws = [e for e in effects if e.key in LAWS and e.where == own.where and e.key != own.key]
    if own.key not in LAWS or not laws:
        return in_place(point, taken, (), records)
    placed = next(p for p in point.placed if p.effect.identity == own.identity)
    rivals = alike_along(point, own, _at_grid(point, placed, laws, records), records, options)
    return not_told_apart(in_place(point, taken, rivals, records), options)


def _at_grid(
    point: WorkingPoint, placed: Placed, laws: Sequence[Effect], records: Fitted
) -> list[Tried]:
    """Return each law in the place of an effect, at the row of its grid that explains most."""
    candidates: list[Candidate] = [(e, tuple(shape)) for e in laws for shape in e.grid]
    train = steadied(gather(point, records.train(point, candidates)))
    train = without_effect(train, columns_of(point, placed), placed.amplitudes)
    best: dict[str, Tried] = {}
    for i, blocks in enumerate(gains_beside(train)):
        (effect, shape), gain = candidates[i], float(blocks.sum())
        before = best.get(effect.identity)
        if not np.isfinite(gain) or (before is not None and before.gain >= gain):
            continue
        best[effect.identity] = regressed(train, i, Tried(effect, shape, gain, blocks, ()))[0]
    return list(best.values())
