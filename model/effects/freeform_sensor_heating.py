"""Free-form thermal error of a sensor: a reading that follows a coil's losses after a lag.

The losses heat the sensor's mount, its core or the common base plate. Like the forms in `freeform`
it does not name a cause: it gives sensor, coil and time constant. The heat at a record's begin
follows from the coil's commands before it.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from functools import partial

import numpy as np

from .base import Effect, Places, Quantity, Signals, Term, on_sensor
from .coil_drift import carried
from .lag_and_hysteresis_recursions import heat

_KEY = re.compile(r"unknown\.warming\.coil_(?P<coil>[0-9]+)")
_TIMES_S = (3.0, 12.0, 48.0)
_BEFORE_S, _LONGEST_BEFORE_S = 3.0, 60.0
"""Time from lift-off to the first record: start value and upper bound."""


def thermal_reading_effects(places: Places) -> list[Effect]:
    """Return the thermal error of every sensor by every coil."""
    return [_warming(places, s, c) for s in range(places.sensors) for c in range(places.coils)]


def thermal_reading_effect(places: Places, key: str, where: Sequence[str]) -> Effect | None:
    """Return the thermal error with a model file's key and location; None for other keys."""
    found = _KEY.fullmatch(key)
    sensors = [f"sensor:{s}" for s in range(places.sensors)]
    if found is None or len(where) != 1 or where[0] not in sensors:
        return None
    coil = int(found["coil"])
    if coil >= places.coils or found["coil"] != str(coil):
        return None
    return _warming(places, sensors.index(where[0]), coil)


def thermal_reading_signals(effect: Effect) -> tuple[str, ...]:
    """Return the heating coil of a thermal error, such as coil:3; () for other effects."""
    found = _KEY.fullmatch(effect.key)
    return () if found is None else (f"coil:{found['coil']}",)


def _warming(places: Places, sensor: int, coil: int) -> Effect:
    return Effect(
        f"unknown.warming.coil_{coil}",
        f"Reading that slowly follows the losses of {places.actuator(coil)}",
        "unknown",
        (f"sensor:{sensor}",),
        "c0 + c1 heat, heat' = (F^2 - heat) / tau; heat = 0 and F as in the first row from "
        "`before` the session's first record on",
        (
            Quantity("c0", places.sensor_unit),
            Quantity("c1", f"{places.sensor_unit}/{places.coil_unit}^2"),
        ),
        partial(_readings, sensor=sensor, coil=coil),
        (
            Quantity("tau", "s", 0.5, 1000.0, log=True),
            Quantity("before", "s", 0.1, _LONGEST_BEFORE_S, log=True),
        ),
        tuple((tau, _BEFORE_S) for tau in _TIMES_S),
        told_apart_by=f"long records in which {places.actuator(coil)} has first more, then less "
        "force than at rest",
    )


def _readings(signals: Signals, shape: Sequence[float], *, sensor: int, coil: int) -> list[Term]:
    F, (tau_s, before_s) = signals.coil[:, coil], shape
    warm = heat(F * F, tau_s, signals.Ts_s, carried(signals, coil, tau_s, before_s))
    return [on_sensor(signals, sensor, np.ones(signals.rows)), on_sensor(signals, sensor, warm)]
