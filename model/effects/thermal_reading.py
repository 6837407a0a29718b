"""A reading that follows a coil's losses with the time constant of a body that they warm.

Heat goes where it finds metal: into the post of a sensor, the core of one, the plate that both
stand on. A free form as those of `freeform`: it names nothing. It says which sensor, which coil and
how slowly. What was warm when a record began is known from what the coil carried before.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from functools import partial

import numpy as np

from .base import Effect, Places, Quantity, Signals, Term, on_sensor
from .coil_drift import carried
from .recursions import heat

_KEY = re.compile(r"unknown\.warming\.coil_(?P<coil>[0-9]+)")
_TIMES_S = (3.0, 12.0, 48.0)
_BEFORE_S, _LONGEST_BEFORE_S = 3.0, 60.0
"""From lift-off to the first record."""


def warmings(places: Places) -> list[Effect]:
    """Return those of every sensor by every coil."""
    return [_warming(places, s, c) for s in range(places.sensors) for c in range(places.coils)]


def warming(places: Places, key: str, where: Sequence[str]) -> Effect | None:
    """Return the effect that a model file names by key and place; None if it is none."""
    found = _KEY.fullmatch(key)
    sensors = [f"sensor:{s}" for s in range(places.sensors)]
    if found is None or len(where) != 1 or where[0] not in sensors:
        return None
    coil = int(found["coil"])
    if coil >= places.coils or found["coil"] != str(coil):
        return None
    return _warming(places, sensors.index(where[0]), coil)


def warmed_by(effect: Effect) -> tuple[str, ...]:
    """Return the coil that an effect is warmed by, as reports have it; () if it is none."""
    found = _KEY.fullmatch(effect.key)
    return () if found is None else (f"coil:{found['coil']}",)


def _warming(places: Places, sensor: int, coil: int) -> Effect:
    return Effect(
        f"unknown.warming.coil_{coil}",
        f"Reading that follows the losses of coil:{coil} slowly",
        "unknown",
        (f"sensor:{sensor}",),
        "c0 + c1 heat, heat' = (F^2 - heat) / tau, cold and told F as at first since `before` the "
        "session's first record",
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
        told_apart_by=f"long records in which coil:{coil} carries more, then less, than it does at "
        "rest",
    )


def _readings(signals: Signals, shape: Sequence[float], *, sensor: int, coil: int) -> list[Term]:
    F, (tau_s, before_s) = signals.coil[:, coil], shape
    warm = heat(F * F, tau_s, signals.Ts_s, carried(signals, coil, tau_s, before_s))
    return [on_sensor(signals, sensor, np.ones(signals.rows)), on_sensor(signals, sensor, warm)]
