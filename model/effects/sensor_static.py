"""Static sensor errors: gain, offset, drift, nonlinearity, crosstalk.

Inductive sensors are nonlinear in the gap, drift with temperature, and have crosstalk if their
coils are close (Fleming, *A review of nanometer resolution position sensors*, Sensors and Actuators
A 190, 2013). Signature: with nine sensors for three DOFs, a sensor's error appears in the non-rigid
part of the readings, with that sensor's pattern. Effects of coils and rods do not appear in the
non-rigid part of the readings.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import numpy as np

from .base import Effect, Places, Quantity, Signals, Term, on_sensor
from .operating_range import Extent

_WARM_S = 80.0
_MOST_BENT = 0.4
"""Largest k h at the sensors' RMS motion; peaks are twice that, and k h stays above -1."""
_LEAST_LEFT = 0.05
_MOST_GAIN = 3.0
"""Bound of the gain error: a dead sensor has -1, a sensor with reversed polarity -2."""


def effects(places: Places, extent: Extent) -> list[Effect]:
    """Return gain, offset, drifts and nonlinearity of every sensor, and crosstalk of every pair."""
    unit, spare = places.sensor_unit, places.sensors > len(places.dof)
    found = []
    for s in range(places.sensors):
        where = (f"sensor:{s}",)
        for key, title, effect_class, equation, quantity, power in (
            ("sensor_gain", "Gain of a sensor", "sensor_gain", "reading = (1 + gain) h",
             Quantity("gain", "1", -_MOST_GAIN, _MOST_GAIN), 1),
            ("sensor_nonlinearity.quadratic", "Quadratic nonlinearity of a sensor",
             "sensor_nonlinearity", "reading = h + a h^2", Quantity("a", f"1/{unit}"), 2),
            ("sensor_nonlinearity.cubic", "Cubic nonlinearity of a sensor",
             "sensor_nonlinearity", "reading = h + b h^3", Quantity("b", f"1/{unit}^2"), 3),
        ):  # fmt: skip
            found.append(
                Effect(
                    key,
                    title,
                    effect_class,
                    where,
                    equation,
                    (quantity,),
                    partial(_power_of_gap, sensor=s, power=power),
                    absorbed_by=_absorbed(spare, power),
                    told_apart_by="excitation of all DOFs, at two amplitudes",
                )
            )
        most = _MOST_BENT / extent.gap
        found.append(
            Effect(
                "sensor_nonlinearity.inverse",
                "Inverse-distance nonlinearity of a sensor",
                "sensor_nonlinearity",
                where,
                "reading = h + a h^2 / (1 + k h): inductance is proportional to 1 / distance",
                (Quantity("a", f"1/{unit}"),),
                partial(_inverse, sensor=s),
                (Quantity("k", f"1/{unit}", -most, most),),
                ((0.0,),),
                absorbed_by=_absorbed(spare, 2),
                told_apart_by="excitation of all DOFs, at two amplitudes",
            )
        )
        if spare:
            # Without redundant sensors an offset equals the free constant force.
            found.append(
                Effect(
                    "sensor_offset.constant",
                    "Offset of a sensor",
                    "sensor_offset",
                    where,
                    "reading = h + offset",
                    (Quantity("offset", unit),),
                    partial(_constant, sensor=s),
                    absorbed_by="offsets that equal a pose: constant forces",
                    told_apart_by="any record: no pose of a rigid platform gives these readings",
                )
            )
        found.append(
            Effect(
                "sensor_offset.drift",
                "Drifting offset of a sensor",
                "sensor_offset",
                where,
                "reading = h + rate t, t from the session's begin",
                (Quantity("rate", f"{unit}/s"),),
                partial(_drift, sensor=s),
                absorbed_by="drifts that equal a pose: drifting forces",
                told_apart_by="long records",
            )
        )
        found.append(
            Effect(
                "sensor_offset.warm_up",
                "Warm-up drift of a sensor",
                "sensor_offset",
                where,
                "reading = h + a (1 - exp(-t / tau)), t from the session's begin",
                (Quantity("a", unit),),
                partial(_warm_up, sensor=s),
                (Quantity("tau", "s", 5.0, 3000.0, log=True),),
                ((_WARM_S,),),
                absorbed_by="for t far below tau: a drift; offsets that equal a pose: forces",
                told_apart_by="records from the begin of a session until long after tau",
            )
        )
    return found + _crosstalk(places)


def _absorbed(spare: bool, power: int) -> str:
    if not spare:
        return "the model itself" if power == 1 else "a nonlinearity of the platform"
    return "same for all sensors: the whole model, by the same factor" if power == 1 else ""


def _crosstalk(places: Places) -> list[Effect]:
    return [
        Effect(
            "sensor_crosstalk",
            "Crosstalk from another sensor's gap",
            "sensor_crosstalk",
            (f"sensor:{s}", f"sensor:{other}"),
            "reading = h + share h of the second",
            (Quantity("share", "1", -1.0, 1.0),),
            partial(_other, sensor=s, other=other),
            told_apart_by="simultaneous excitation of all DOFs",
        )
        for s in range(places.sensors)
        for other in range(places.sensors)
        if other != s
    ]


def _power_of_gap(
    signals: Signals, _shape: Sequence[float], *, sensor: int, power: int
) -> list[Term]:
    h = signals.gap(sensor)
    return [on_sensor(signals, sensor, (h, h * h, h * h * h)[power - 1])]


def _inverse(signals: Signals, shape: Sequence[float], *, sensor: int) -> list[Term]:
    h = signals.gap(sensor)
    # During a fit, simulated gaps can exceed the measured range.
    return [on_sensor(signals, sensor, h * h / np.maximum(1.0 + shape[0] * h, _LEAST_LEFT))]


def _constant(signals: Signals, _shape: Sequence[float], *, sensor: int) -> list[Term]:
    return [on_sensor(signals, sensor, np.ones(signals.rows))]


def _drift(signals: Signals, _shape: Sequence[float], *, sensor: int) -> list[Term]:
    return [on_sensor(signals, sensor, signals.time_s)]


def _warm_up(signals: Signals, shape: Sequence[float], *, sensor: int) -> list[Term]:
    passed = np.maximum(signals.time_s, 0.0) / shape[0]
    return [on_sensor(signals, sensor, -np.expm1(-passed))]


def _other(signals: Signals, _shape: Sequence[float], *, sensor: int, other: int) -> list[Term]:
    return [on_sensor(signals, sensor, signals.gap(other))]
