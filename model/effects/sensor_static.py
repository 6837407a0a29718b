"""Sensors that show something else than the height: gain, offset, nonlinearity, another's gap.

Inductive sensors are nonlinear in the gap, drift with temperature, and couple where their coils lie
close (Fleming, *A review of nanometer resolution position sensors*, Sensors and Actuators A 190,
2013). Signature: nine sensors for three DOFs; what one shows wrongly shows in the directions in
which a rigid platform shows nothing, with that sensor's pattern. Coils and rods show nothing there.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import numpy as np

from .base import Effect, Places, Quantity, Signals, Term, on_sensor
from .driven_range import Extent

_WARM_S = 80.0
_MOST_BENT = 0.4
"""k h where sensors move, rms; peaks are twice that, and k h stays above -1."""
_LEAST_LEFT = 0.05
_MOST_GAIN = 3.0
"""A dead sensor has a gain of -1, one that is wired the wrong way round -2: not at the bound."""


def effects(places: Places, extent: Extent) -> list[Effect]:
    """Return gain, offset, drifts, nonlinearity of every sensor, crosstalk between any two."""
    unit, spare = places.sensor_unit, places.sensors > len(places.dof)
    found = []
    for s in range(places.sensors):
        where = (f"sensor:{s}",)
        for key, title, effect_class, equation, quantity, power in (
            ("sensor_gain", "Gain of a sensor", "sensor_gain", "reading = (1 + gain) h",
             Quantity("gain", "1", -_MOST_GAIN, _MOST_GAIN), 1),
            ("sensor_nonlinearity.quadratic", "Sensor that is not straight", "sensor_nonlinearity",
             "reading = h + a h^2", Quantity("a", f"1/{unit}"), 2),
            ("sensor_nonlinearity.cubic", "Sensor with a gain that changes to both sides",
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
                    told_apart_by="all DOFs excited, at two amplitudes",
                )
            )
        most = _MOST_BENT / extent.gap
        found.append(
            Effect(
                "sensor_nonlinearity.inverse",
                "Sensor that is bent more to one side",
                "sensor_nonlinearity",
                where,
                "reading = h + a h^2 / (1 + k h): inductance falls as one over the distance",
                (Quantity("a", f"1/{unit}"),),
                partial(_inverse, sensor=s),
                (Quantity("k", f"1/{unit}", -most, most),),
                ((0.0,),),
                absorbed_by=_absorbed(spare, 2),
                told_apart_by="all DOFs excited, at two amplitudes",
            )
        )
        if spare:
            # Without spare sensors a constant one is the free constant force.
            found.append(
                Effect(
                    "sensor_offset.constant",
                    "Offset of a sensor",
                    "sensor_offset",
                    where,
                    "reading = h + offset",
                    (Quantity("offset", unit),),
                    partial(_constant, sensor=s),
                    absorbed_by="offsets that are a pose: constant forces",
                    told_apart_by="any record: a rigid platform shows no such pose",
                )
            )
        found.append(
            Effect(
                "sensor_offset.drift",
                "Offset of a sensor that drifts",
                "sensor_offset",
                where,
                "reading = h + rate t, t from the session's begin",
                (Quantity("rate", f"{unit}/s"),),
                partial(_drift, sensor=s),
                absorbed_by="drifts that are a pose: drifting forces",
                told_apart_by="long records",
            )
        )
        found.append(
            Effect(
                "sensor_offset.warm_up",
                "Sensor that warms up",
                "sensor_offset",
                where,
                "reading = h + a (1 - exp(-t / tau)), t from the session's begin",
                (Quantity("a", unit),),
                partial(_warm_up, sensor=s),
                (Quantity("tau", "s", 5.0, 3000.0, log=True),),
                ((_WARM_S,),),
                absorbed_by="while t is far below tau: a drift; offsets that are a pose: forces",
                told_apart_by="records from the begin of a session to long after tau",
            )
        )
    return found + _crosstalk(places)


def _absorbed(spare: bool, power: int) -> str:
    if not spare:
        return "the model itself" if power == 1 else "as far as a platform may be nonlinear too"
    return "all sensors alike: all of the model, by the same share" if power == 1 else ""


def _crosstalk(places: Places) -> list[Effect]:
    return [
        Effect(
            "sensor_crosstalk",
            "Sensor that shows a part of another's gap",
            "sensor_crosstalk",
            (f"sensor:{s}", f"sensor:{other}"),
            "reading = h + share h of the second",
            (Quantity("share", "1", -1.0, 1.0),),
            partial(_other, sensor=s, other=other),
            told_apart_by="all DOFs excited at once",
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
    # What is simulated on the way to a fit may go further than what was measured.
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
