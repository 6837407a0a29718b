"""Sinusoidal disturbances (mains, fans, pumps): forces, ground vibration, pick-up in readings.

A sinusoidal disturbance (a spectral line) keeps its frequency and phase over a session, whatever
the excitation. Signature: in the spectrum of still records, a peak at one frequency. A force moves
the rigid platform; pick-up in one sensor appears in the non-rigid part of the readings; pick-up can
also be equal in all sensors (Morrison, *Grounding and Shielding*, 2016). Vertical ground vibration
acts on every mass in proportion to it, on the beam's mass at x_b. Random vibration has no phase and
counts as noise.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import numpy as np

from .base import Array, Effect, Places, Quantity, Signals, Term, on_dof, on_sensor

_NEAR = 0.005
"""Relative search range of a line's frequency."""


def tone(places: Places, f_hz: float) -> list[Effect]:
    """Return lines at f_hz: force on every DOF, ground vibration, pick-up of one or all sensors."""
    frequency, grid, label = _frequency(f_hz), ((f_hz,),), f"{f_hz:.4g} Hz"
    found = [
        Effect(
            f"vibration.force.{f_hz:.6g}hz",
            f"Vibration at {label}",
            "vibration",
            (dof,),
            "force = a cos(2 pi frequency t) + b sin(2 pi frequency t)",
            _both(places.force_unit(i)),
            partial(_force, dof=i),
            frequency,
            grid,
            absorbed_by="without a line: force noise",
            told_apart_by="still records, long compared with the line's period"
            if places.beam
            else "a second sensor, and records without a command",
        )
        for i, dof in enumerate(places.dof)
    ]
    if places.beam:
        found.append(
            Effect(
                f"vibration.floor.{f_hz:.6g}hz",
                f"Vertical ground vibration at {label}",
                "vibration",
                (places.dof[2],),
                "force = a cos(2 pi frequency t) + b sin(2 pi frequency t) at z, and share x_b "
                "times that at theta; share = m_b / m",
                _both(places.force_unit(2)),
                _ground,
                (*frequency, Quantity("share", "1", 0.0, 1.0)),
                ((f_hz, 0.2),),
                absorbed_by="without a line: force noise",
                told_apart_by="still records at several beam positions",
            )
        )
    if not places.beam and places.sensors == len(places.dof):
        # Each sensor reads one DOF, and users know it by this name.
        return found + [
            _picked_up(places, label, f_hz, (dof,), s) for s, dof in enumerate(places.dof)
        ]
    every = tuple(f"sensor:{s}" for s in range(places.sensors))
    found += [_picked_up(places, label, f_hz, (one,), s) for s, one in enumerate(every)]
    if len(every) > 1:
        found.append(_picked_up(places, label, f_hz, every, None))
    return found


def _picked_up(
    places: Places, label: str, f_hz: float, where: tuple[str, ...], sensor: int | None
) -> Effect:
    """Return a line in the readings of one sensor, or the same in all.

    Where a sensor is named by the DOF that it reads, it has a class of its own: a force on this DOF
    is another cause.
    """
    return Effect(
        f"vibration.reading.{f_hz:.6g}hz",
        f"Pick-up of {label}" + (", same for all sensors" if sensor is None else ""),
        "sensor_pickup" if where[0] in places.dof else "vibration",
        where,
        "reading = h + a cos(2 pi frequency t) + b sin(2 pi frequency t)",
        _both(places.sensor_unit if places.beam else places.dof_units[sensor or 0]),
        partial(_reading, sensor=sensor),
        _frequency(f_hz),
        ((f_hz,),),
        told_apart_by="still records" if places.beam else "a second sensor",
    )


def _frequency(f_hz: float) -> tuple[Quantity]:
    return (Quantity("frequency", "Hz", (1 - _NEAR) * f_hz, (1 + _NEAR) * f_hz),)


def _both(unit: str) -> tuple[Quantity, Quantity]:
    return Quantity("a", unit), Quantity("b", unit)


def _force(signals: Signals, shape: Sequence[float], *, dof: int) -> list[Term]:
    return [on_dof(signals, dof, wave) for wave in _waves(signals, shape[0])]


def _ground(signals: Signals, shape: Sequence[float]) -> list[Term]:
    terms = []
    for wave in _waves(signals, shape[0]):
        force = np.zeros((signals.rows, len(signals.places.dof)))
        force[:, 1], force[:, 2] = shape[1] * signals.x_b_m * wave, wave
        terms.append(Term(force=force))
    return terms


def _reading(signals: Signals, shape: Sequence[float], *, sensor: int | None) -> list[Term]:
    waves = _waves(signals, shape[0])
    if sensor is not None:
        return [on_sensor(signals, sensor, wave) for wave in waves]
    return [Term(gap=np.repeat(wave[:, None], signals.places.sensors, axis=1)) for wave in waves]


def _waves(signals: Signals, f_hz: float) -> tuple[Array, Array]:
    angle = 2 * np.pi * f_hz * signals.time_s
    return np.cos(angle), np.sin(angle)
