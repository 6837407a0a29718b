"""Free-form leaky integral of a signal: a response that builds up and decays, such as heat.

The positive and negative parts of the signal about its middle, each with its own amplitude, after a
first-order lag. Like the forms in `freeform` it does not name a cause: it gives the signal, the
location and the time constant.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from functools import partial
from math import inf

import numpy as np
from numpy.typing import NDArray

from .base import Effect, Places, Quantity, Signals, Term, on_dof, on_sensor
from .lag_and_hysteresis_recursions import lagged
from .operating_range import Extent

Array = NDArray[np.float64]

POWER = "a_b_v_b"
"""Mechanical power of the beam's drive over the beam's mass, without friction."""
_BEAM = ("v_b", "a_b", POWER, "phi_speed")
_SPOKEN = {POWER: "a_b v_b", "phi_speed": "phi'"}
_COIL = "coil_"
_KEY = re.compile(
    r"unknown\.lingering\.(?P<by>\w+)\[(?:(?P<middle>[0-9.e+-]+)\+-)?(?P<scale>[0-9.e+-]+)\]"
)
_TIMES_S = (0.1, 0.4, 1.6, 6.4)
"""Start values of the time constant; the factor 4 is small enough for values in between."""


def leaky_integral_effects(places: Places, extent: Extent) -> list[Effect]:
    """Return leaky integrals of beam and rotor signals (DOFs, sensors) and commands (sensors)."""
    found = []
    if places.beam:
        at = [*places.dof, *(f"sensor:{s}" for s in range(places.sensors))]
        found += [_build_effect(places, w, by, 0.0, _scale(extent, by)) for by in _BEAM for w in at]
    for c, (middle, sd) in enumerate(extent.commands):
        if sd > 0.0:
            found += [
                _build_effect(places, f"sensor:{s}", f"{_COIL}{c}", middle, sd)
                for s in range(places.sensors)
            ]
    return found


def leaky_integral_effect(places: Places, key: str, where: Sequence[str]) -> Effect | None:
    """Return the leaky integral with a model file's key and location; None for other keys."""
    found = _KEY.fullmatch(key)
    sensors = [f"sensor:{s}" for s in range(places.sensors)]
    if found is None or len(where) != 1 or where[0] not in (*places.dof, *sensors):
        return None
    coils = [f"{_COIL}{c}" for c in range(places.coils)] if where[0] in sensors else []
    coiled = found["by"].startswith(_COIL)
    if found["by"] not in (*_BEAM, *coils) or coiled != (found["middle"] is not None):
        return None
    try:
        middle, scale = float(found["middle"] or 0.0), float(found["scale"])
    except ValueError:
        return None
    if not (0.0 < scale < inf and abs(middle) < inf):
        return None
    return _build_effect(places, where[0], found["by"], middle, scale)


def leaky_integral_signals(effect: Effect) -> tuple[str, ...]:
    """Return the signals that a leaky integral integrates, as in keys; () for other effects."""
    found = _KEY.fullmatch(effect.key)
    if found is None:
        return ()
    return ("a_b", "v_b") if found["by"] == POWER else (found["by"],)


def _scale(extent: Extent, by: str) -> float:
    # Without motion any scale is valid: use the rig's.
    v, a, phi = (rate or usual for rate, usual in zip(extent.beam_rates, (0.4, 4, 40), strict=True))
    return float(f"{ {'v_b': v, 'a_b': a, POWER: v * a, 'phi_speed': phi}[by]:.3g}")


def _build_effect(places: Places, where: str, by: str, middle: float, scale: float) -> Effect:
    coiled = by.startswith(_COIL)
    word = _SPOKEN.get(by, by)
    if coiled:
        word = places.actuator(int(by.removeprefix(_COIL)))
    if where in places.dof:
        dof = places.dof.index(where)
        what, unit = "Force", places.force_unit(dof)
        build = partial(_forces, by=by, middle=middle, scale=scale, dof=dof)
    else:
        sensor = int(where.partition(":")[2])
        what, unit = "Reading", places.sensor_unit
        build = partial(_readings, by=by, middle=middle, scale=scale, sensor=sensor)
    signal = f"the command of {word}" if coiled else word
    measured = f"{middle:g}+-{scale:g}" if coiled else f"{scale:g}"
    u = f"({word} - {middle:g})" if middle else word
    return Effect(
        f"unknown.lingering.{by}[{measured}]",
        f"{what} that builds up with {signal} and decays",
        "unknown",
        (where,),
        f"c1 s1 + c2 s2, tau s1' = max(u, 0) - s1, tau s2' = max(-u, 0) - s2, u = {u} / {scale:g}",
        (Quantity("c1", unit), Quantity("c2", unit)),
        build,
        (Quantity("tau", "s", 0.01, 300.0, log=True),),
        tuple((tau,) for tau in _TIMES_S),
        told_apart_by=f"records in which only {signal} changes, fast, and then stays constant",
    )


def _forces(
    signals: Signals, shape: Sequence[float], *, by: str, middle: float, scale: float, dof: int
) -> list[Term]:
    return [on_dof(signals, dof, s) for s in _sides(signals, shape[0], by, middle, scale)]


def _readings(
    signals: Signals, shape: Sequence[float], *, by: str, middle: float, scale: float, sensor: int
) -> list[Term]:
    return [on_sensor(signals, sensor, s) for s in _sides(signals, shape[0], by, middle, scale)]


def _sides(
    signals: Signals, tau_s: float, by: str, middle: float, scale: float
) -> tuple[Array, Array]:
    """Return the lagged positive and negative parts (N,) of the signal, settled at row 0."""
    u = (_signal(signals, by) - middle) / scale
    above, below = (lagged(np.maximum(side, 0.0), tau_s, signals.Ts_s) for side in (u, -u))
    return above, below


def _signal(signals: Signals, by: str) -> Array:
    if by.startswith(_COIL):
        return signals.acting(signals.coil[:, int(by.removeprefix(_COIL))])
    if by == POWER:
        return np.asarray(signals.a_b_m_s2 * signals.v_b_m_s)
    return np.asarray(
        {"v_b": signals.v_b_m_s, "a_b": signals.a_b_m_s2, "phi_speed": signals.phi_rad_s}[by]
    )
