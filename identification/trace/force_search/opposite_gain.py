"""Name the other one of two sensors or actuators, if records only determine the ratio of the gains.

If all numbers of a model are free, all of its forces may grow in proportion. Records then cannot
tell a sensor that reads too large from a second one that reads too small. A large gain, as that of
a file with millimetres for metres, is too far for the linear rating to find this equivalent. So the
whole model is fitted with it, from the numbers that are in proportion.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ....model.effects.base import Effect, Placed
from ..force_balance.force_record import ForceModel
from ..force_regression.gauss_newton_fit import fit_numbers
from ..force_regression.training_records import Training
from ..search_options import SearchOptions
from .compare_fitted_candidates import is_as_good
from .search import Searched

FACTOR_LESS_ONE = {
    "reading.gain": -1.0,
    "reading.gain.all": -1.0,
    "coil_gain": 1.0,
    "coil_gain.all": 1.0,
}
"""By the key of a gain, the factor of its column less one, per unit of its amplitude."""


def with_opposite_gains(
    found: Searched, laws: Sequence[Effect], training: Training, options: SearchOptions
) -> Searched:
    """Return the result with the other gain of two among the alternatives of a found gain.

    If the other gain fits as well and keeps the model's parameters nearer to the declared values,
    it takes the place of the found one. laws: the table of effects.
    """
    for i, rated in enumerate(found.rated):
        own = next(p for p in found.point.placed if p.effect == rated.placed.effect)
        others = [e for e in laws if e.key == own.effect.key and e.where != own.effect.where]
        named = {r.placed.effect.where for r in rated.alternatives}
        if own.effect.key not in FACTOR_LESS_ONE or len(others) != 1 or others[0].where in named:
            continue
        other = opposite_gain(found.point, own, others[0], training)
        if other is None:
            continue
        point = _last(found.point, own)
        rest = replace(point, placed=point.placed[:-1])
        if not is_as_good(other, point, rest, rated, training, options):
            continue
        half = 0.5 * rated.support
        mine = replace(rated, placed=own, support=half)
        rival = replace(rated, placed=other.placed[-1], support=half, alternatives=())
        if distance_from_declared(other) < distance_from_declared(point):
            alone = replace(mine, alternatives=())
            mine, point = replace(rival, alternatives=(*rated.alternatives, alone)), other
        else:
            mine = replace(mine, alternatives=(*mine.alternatives, rival))
        found = replace(found, point=point, rated=(*found.rated[:i], mine, *found.rated[i + 1 :]))
    return found


def opposite_gain(
    point: ForceModel, own: Placed, other: Effect, training: Training
) -> ForceModel | None:
    """Return the fitted model with the other gain in the place of a found one, as its last effect;
    None if no gain of the other signal gives the same ratio.

    Only the ratio of the two factors shows: 1 and f have the same one as 1/f and 1, and the model's
    parameters are then f times as large for readings, and 1/f times for commands.
    """
    sign, factor = FACTOR_LESS_ONE[own.effect.key], column_factor(own)
    if not factor > 0.0:
        return None
    amplitude, grown = sign * (1.0 / factor - 1.0), factor if sign < 0.0 else 1.0 / factor
    bound = other.amplitudes[0]
    if not bound.low <= amplitude <= bound.high:
        return None
    free, kept = point.parameters, tuple(p for p in point.placed if p is not own)
    values = np.clip(grown * point.values, free.low, free.high)
    begin = replace(point, placed=(*kept, Placed(other, (), (amplitude,))))
    return fit_numbers(training, begin.with_values(values))


def column_factor(gain: Placed) -> float:
    """Return the factor by which a gain multiplies the column of its sensor or actuator."""
    return 1.0 + FACTOR_LESS_ONE[gain.effect.key] * gain.amplitudes[0]


def distance_from_declared(point: ForceModel) -> float:
    """Return how far the parameters of a model are from their declared values, as the sum of the
    squared logarithms of the ratios."""
    declared = point.parameters.prior_mean
    known = (declared != 0.0) & (point.values * declared > 0.0)
    if not known.all():
        return float("inf")
    return float(np.sum(np.log(point.values / declared) ** 2))


def _last(point: ForceModel, own: Placed) -> ForceModel:
    """Return the model with one of its effects moved to the end."""
    return replace(point, placed=(*(p for p in point.placed if p is not own), own))
