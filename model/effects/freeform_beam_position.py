"""Free-form wave along the beam's travel, multiplied by the beam's speed or acceleration.

Parts along the travel repeat with a pitch: screws, poles, balls. An effect that also depends on the
beam's speed or acceleration is not a function of its position. Like the forms in `freeform` it does
not name a cause: it gives location, factor and period.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from functools import partial

import numpy as np
from numpy.typing import NDArray

from .base import Effect, Places, Quantity, Signals, Term, on_sensor
from .base_magnets_attracting_beam import PERIOD_M, at_the_beam, periods_m, waves_along
from .operating_range import Extent

Array = NDArray[np.float64]

_PLACE, _SQUARED = "place", "v_b_squared"
_FACTORS = ("v_b", "a_b", _SQUARED)
_SPOKEN = {_SQUARED: "v_b^2"}
_KEY = re.compile(r"unknown\.wave\.(?P<factor>\w+)(?:\[(?P<unit>[0-9.e+-]+)\])?")


def wave_effects(places: Places, extent: Extent) -> list[Effect]:
    """Return the waves of every DOF and sensor; empty for a plant without a beam.

    A force that depends on x_b only is the effect `external_field` and is not repeated here.
    """
    if not places.beam:
        return []
    sensors = [f"sensor:{s}" for s in range(places.sensors)]
    periods = periods_m(extent)
    found = [
        _wave(places, where, factor, _unit(extent, factor), periods)
        for factor in _FACTORS
        for where in (*places.dof, *sensors)
    ]
    return found + [_wave(places, where, _PLACE, 1.0, periods) for where in sensors]


def wave_effect(places: Places, key: str, where: Sequence[str]) -> Effect | None:
    """Return the wave with a model file's key and location; None for other keys."""
    found = _KEY.fullmatch(key)
    sensors = [f"sensor:{s}" for s in range(places.sensors)]
    if found is None or not places.beam or len(where) != 1:
        return None
    factor = found["factor"]
    if where[0] not in sensors and (where[0] not in places.dof or factor == _PLACE):
        return None
    if factor not in (_PLACE, *_FACTORS) or (factor == _PLACE) != (found["unit"] is None):
        return None
    try:
        unit = float(found["unit"] or 1.0)
    except ValueError:
        return None
    if not 0.0 < unit < np.inf:
        return None
    return _wave(places, where[0], factor, unit, periods_m(Extent.typical(places)))


def wave_signals(effect: Effect) -> tuple[str, ...]:
    """Return the signals that a wave depends on; () for other effects."""
    found = _KEY.fullmatch(effect.key)
    if found is None:
        return ()
    motion = {_PLACE: (), _SQUARED: ("v_b",)}.get(found["factor"], (found["factor"],))
    return (*motion, "x_b")


def _unit(extent: Extent, factor: str) -> float:
    # Without motion any unit is valid: use the rig's.
    v, a = (rate or usual for rate, usual in zip(extent.beam_rates[:2], (0.4, 4), strict=True))
    return float(f"{ {'v_b': v, 'a_b': a, _SQUARED: v * v}[factor]:.3g}")


def _wave(places: Places, where: str, factor: str, unit: float, periods: Sequence[float]) -> Effect:
    if where in places.dof:
        dof = places.dof.index(where)
        what, force_unit = "Force", places.force_unit(dof)
        build = partial(_forces, factor=factor, unit=unit, dof=dof)
    else:
        dof = None
        sensor = int(where.partition(":")[2])
        what, force_unit = "Reading", places.sensor_unit
        build = partial(_readings, factor=factor, unit=unit, sensor=sensor)
    word = _SPOKEN.get(factor, factor)
    key = f"unknown.wave.{factor}" + ("" if factor == _PLACE else f"[{unit:g}]")
    by = "" if factor == _PLACE else f" times {word}"
    waves = "a cos(2 pi x_b / period) + b sin(2 pi x_b / period)"
    equation = waves if factor == _PLACE else f"{word} / {unit:g} ({waves})"
    if dof is not None and at_the_beam(dof):
        equation += ", x_b times that at theta"
    return Effect(
        key,
        f"{what} with a wave along x_b{by}",
        "unknown",
        (where,),
        equation,
        (Quantity("a", force_unit), Quantity("b", force_unit)),
        build,
        (Quantity("period", "m", 0.25 * PERIOD_M[0], 2 * PERIOD_M[1], log=True),),
        tuple((p,) for p in periods),
        told_apart_by="beam sweeps over the whole travel at several speeds",
    )


def _forces(
    signals: Signals, shape: Sequence[float], *, factor: str, unit: float, dof: int
) -> list[Term]:
    driven = _factor(signals, factor) / unit
    return waves_along(signals, shape[0], dof, driven)


def _readings(
    signals: Signals, shape: Sequence[float], *, factor: str, unit: float, sensor: int
) -> list[Term]:
    driven = _factor(signals, factor) / unit
    angle = 2 * np.pi / shape[0] * signals.x_b_m
    return [on_sensor(signals, sensor, driven * wave(angle)) for wave in (np.cos, np.sin)]


def _factor(signals: Signals, factor: str) -> Array:
    if factor == _PLACE:
        return np.ones(signals.rows)
    if factor == _SQUARED:
        return np.asarray(signals.v_b_m_s**2)
    return signals.v_b_m_s if factor == "v_b" else signals.a_b_m_s2
