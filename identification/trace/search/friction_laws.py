"""Choose the friction law of a DOF: laws exclude each other, and none is added to another one.

While friction is all that the errors hold, several laws explain it alike. So once one was accepted,
all others of that DOF are fitted in its place, all numbers of the model with them, before anything
else is searched in what the first one left.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ....model.declared_model import ModelError
from ....model.effects.base import Effect
from ....model.effects.friction import LAWS
from ...records.record import IdentificationError
from ..linearised.linearisation_point import WorkingPoint
from .candidate_screening import Records, Round, Tried, regressed
from .effects_not_told_apart import Member, in_place, not_told_apart
from .fit_shortlisted_candidates import sifted
from .gauss_newton import Candidate, Fitted, gather
from .regression import gains


def best_laws(
    point: WorkingPoint, taken: Tried, effects: Sequence[Effect], records: Records
) -> list[Member]:
    """Return the law of friction that fits best in the place of an accepted one.

    Laws that the blocks do not tell from it follow. If the accepted effect is no law of friction,
    it is the only one.
    """
    own = taken.effect
    laws = [e for e in effects if e.key in LAWS and e.where == own.where and e.key != own.key]
    if own.key not in LAWS or not laws:
        return in_place(point, taken, (), records)
    others = tuple(p for p in point.placed if p.effect.identity != own.identity)
    without = replace(point, placed=others)
    rivals = _at_grid(without, laws, records)
    best = _sifted(without, rivals, records)
    return not_told_apart(in_place(point, taken, best, records))


def _sifted(without: WorkingPoint, rivals: Sequence[Tried], records: Fitted) -> list[Tried]:
    """Return the rivals that a few steps of a fit leave in the running, the best first."""
    if not rivals:
        return []
    train = gather(without, records.train(without))
    count = float(train.count.sum())
    found = Round(train.excess, count, (), tuple(rivals), (), None, ())
    found, _ = sifted(without, found, train, records)
    assert found.taken is not None
    return [found.taken, *found.alternatives]


def _at_grid(without: WorkingPoint, laws: Sequence[Effect], records: Fitted) -> list[Tried]:
    """Return each law at the row of its grid that explains most, the best first."""
    candidates: list[Candidate] = [(e, tuple(shape)) for e in laws for shape in e.grid]
    try:
        train = gather(without, records.train(without, candidates))
    except (ModelError, IdentificationError, np.linalg.LinAlgError):
        return []
    best: dict[str, Tried] = {}
    for i, blocks in enumerate(gains(train)):
        (effect, shape), gain = candidates[i], float(blocks.sum())
        before = best.get(effect.identity)
        if not np.isfinite(gain) or (before is not None and before.gain >= gain):
            continue
        best[effect.identity] = regressed(train, i, effect, shape, blocks)
    return sorted(best.values(), key=lambda t: -t.gain)
