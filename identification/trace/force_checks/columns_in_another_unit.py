"""Check whether a column of the records is in another unit than the model says.

A position in millimetres, or in counts of an encoder, leaves equations in which hardly a force is
right. Couplings of all kinds then explain a part of them, one after the other. The gain of the
column alone explains all; but it is so large that no rating from the declared model foretells it.
So the model is fitted with the gain of each column from factors over many decades.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ....model.effects import coil_gain, output_readings
from ....model.effects.base import Effect, Placed
from ....model.effects.operating_range import Extent
from ...value_with_interval import in_full
from ..force_balance.force_record import ForceModel
from ..force_regression.gauss_newton_fit import fit_numbers
from ..force_regression.training_records import Training, missing_share
from ..force_search.opposite_gain import (
    FACTOR_LESS_ONE,
    column_factor,
    distance_from_declared,
    opposite_gain,
)
from ..search_options import SearchOptions
from .exchanged_columns import Exchange, explains

Array = NDArray[np.float64]

_FAR, _ALIKE, _FEWEST = 4.0, 1.6, 3
"""Factor by which declared parameters are not guessed wrong together, by which they may differ from
it, and how many of them can show it."""
_STEP, _STEPS = 2.0**SearchOptions.resolved, SearchOptions.resolved
"""Ratio of neighbouring factors that fits begin with, and how many there are either way."""


def explaining_unit(
    start: ForceModel,
    declared: ForceModel,
    found: ForceModel,
    training: Training,
    options: SearchOptions,
) -> Exchange | None:
    """Return which column has another unit, if a model without other effects explains as much then.

    start: the model with the values of its file. declared, found: the fitted model without effects,
    and with those found. None if the model lacks little, and if such a gain is among the effects
    found.
    """
    plain = training.plain
    before, after = (missing_share(plain.at(p)) for p in (declared, found))
    named = {p.effect.effect_class for p in found.placed}
    places = training.records[0].signals.places
    laws = [*coil_gain.effects(places), *output_readings.effects(places, Extent.typical(places))]
    gains = [
        replace(e, amplitudes=tuple(replace(q, low=-np.inf, high=np.inf) for q in e.amplitudes))
        for e in laws
        if e.key in FACTOR_LESS_ONE and e.effect_class not in named
    ]
    if float(before.max()) ** 2 <= options.least_gain:
        free = declared.parameters
        scale = common_factor(declared.values, free.prior_mean)
        moved = [] if scale == 1.0 else [_scaled(declared, e, scale) for e in gains]
        as_good = [
            p for p in moved if np.max(missing_share(plain.at(p)) - before) < options.least_force
        ]
        return Exchange(_either(as_good), before, before) if as_good else None

    def explained(points: Iterable[ForceModel]) -> list[ForceModel]:
        return [p for p in points if explains(missing_share(plain.at(p)), before, after, options)]

    good = explained(p for e in gains for p in _fitted(start, e, plain))
    good += explained(p for one in good for p in _fitted_opposites(one, gains, plain))
    # A smaller error is no other unit, and another sign is not only one.
    far = [p for p in good if column_factor(p.placed[-1]) > 0.0 and _ratio(p.placed[-1]) > 2.0]
    if not far:
        return None
    left = [float(missing_share(plain.at(p)).max()) for p in far]
    least = min(left) + options.least_force
    alike = [p for p, x in zip(far, left, strict=True) if x < least]
    for p in list(alike):
        alike += [q for q in _in_proportion(p) if float(missing_share(plain.at(q)).max()) < least]
    alike = sorted((p for p in alike if _ratio(p.placed[-1]) > 2.0), key=distance_from_declared)
    point, left_then = alike[0], missing_share(plain.at(alike[0]))
    twins = [
        p
        for p in _of_the_other_kind(point, gains, len(places.dof), places.coils)
        if np.max(missing_share(plain.at(p)) - left_then) < options.least_force
    ]
    return Exchange(_either([point, *twins[:1]]), before, left_then)


def _of_the_other_kind(
    point: ForceModel, gains: Sequence[Effect], outputs: int, inputs: int
) -> Iterator[ForceModel]:
    """Yield the model with a gain of all commands in the place of one of all readings, or the other
    way round: its equations are the same."""
    own = point.placed[-1].effect
    count = {-1.0: outputs, 1.0: inputs}
    if len(own.where) < count[FACTOR_LESS_ONE[own.key]]:
        return
    for e in gains:
        sign = FACTOR_LESS_ONE[e.key]
        if sign != FACTOR_LESS_ONE[own.key] and len(e.where) == count[sign]:
            amplitude = sign * (1.0 / column_factor(point.placed[-1]) - 1.0)
            yield replace(point, placed=(*point.placed[:-1], Placed(e, (), (amplitude,))))


def common_factor(values: Array, declared: Array) -> float:
    """Return the factor that most parameters (K,) have in common to their declared values.

    It is 1 if they have none, or one that a poor guess of them explains. If all numbers of a model
    are free, its forces and with them all parameters may grow in proportion.
    """
    told = declared != 0.0
    ratios = values[told] / declared[told]
    logs = np.log(ratios[ratios > 0.0])
    if len(logs) < _FEWEST or abs(middle := float(np.median(logs))) < np.log(_FAR):
        return 1.0
    near = np.abs(logs - middle) < np.log(_ALIKE)
    return float(np.exp(middle)) if 2 * np.count_nonzero(near) > len(declared) else 1.0


def _scaled(declared: ForceModel, effect: Effect, scale: float) -> ForceModel:
    """Return the fitted model with parameters near the declared ones, and a gain instead."""
    sign, free = FACTOR_LESS_ONE[effect.key], declared.parameters
    factor = scale if sign < 0.0 else 1.0 / scale
    placed = (*declared.placed, Placed(effect, (), (sign * (factor - 1.0),)))
    values = np.clip(declared.values / scale, free.low, free.high)
    return replace(declared, placed=placed).with_values(values)


def _either(points: Sequence[ForceModel]) -> str:
    """Return in words what one or the other gain says: of one column before those of several."""
    ordered = sorted(points, key=lambda p: len(p.placed[-1].effect.where))
    return ", or ".join(dict.fromkeys(_words(p.placed[-1]) for p in ordered[:2]))


def _fitted(start: ForceModel, effect: Effect, training: Training) -> Iterator[ForceModel]:
    """Yield the fits of a model with a gain, that of a reading from factors over many decades.

    The gain of a command and the parameters of the model are linear in the force.
    """
    sign = FACTOR_LESS_ONE[effect.key]
    factors = [_STEP**k for k in range(-_STEPS, _STEPS + 1) if k] if sign < 0.0 else [1.0]
    for factor in factors:
        placed = (*start.placed, Placed(effect, (), (sign * (factor - 1.0),)))
        yield fit_numbers(training, replace(start, placed=placed))


def _fitted_opposites(
    point: ForceModel, gains: Sequence[Effect], training: Training
) -> Iterator[ForceModel]:
    """Yield the fit of a model with the other one of two gains in the place of its last effect."""
    own = point.placed[-1]
    others = [e for e in gains if e.key == own.effect.key and e.where != own.effect.where]
    fitted = opposite_gain(point, own, others[0], training) if len(others) == 1 else None
    if fitted is not None:
        yield fitted


def _in_proportion(point: ForceModel) -> Iterator[ForceModel]:
    """Yield models with the parameters in proportion nearer to the declared ones, and the gain.

    If all parameters are free, records only determine their ratios to the gain.
    """
    declared, gain = point.parameters.prior_mean, point.placed[-1]
    if np.any(point.values * declared <= 0.0):
        return
    # Of parameters that only have a sum in common, one may be next to nothing: hence the median.
    grown = float(np.exp(np.median(np.log(declared / point.values))))
    sign, factor = FACTOR_LESS_ONE[gain.effect.key], column_factor(gain)
    values = np.clip(grown * point.values, point.parameters.low, point.parameters.high)
    for changed in (factor * grown, factor / grown):
        placed = (*point.placed[:-1], Placed(gain.effect, (), (sign * (changed - 1.0),)))
        yield replace(point, placed=placed).with_values(values)


def _ratio(gain: Placed) -> float:
    """Return by which factor above one the column is too large, or too small."""
    factor = abs(column_factor(gain))
    return max(factor, 1.0 / factor) if factor > 0.0 else np.inf


def _words(gain: Placed) -> str:
    """Return what the gain says, as 'y is in another unit, 1000 times too large'."""
    ratio, where = in_full(_ratio(gain)), gain.effect.where
    size = f"{ratio} times too {'large' if column_factor(gain) < 1.0 else 'small'}"
    verb = "is" if len(where) == 1 else "are"
    return f"{' and '.join(where)} {verb} in another unit, {size}"
