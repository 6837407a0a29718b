"""Scale of all sensors or all coils, and arm lengths that differ from the declared ones.

A model is identified in the units of its sensors and actuators. If all sensors read too much by one
factor, masses and stiffness come out too small by it, and the motion is explained as well; only a
known force tells, as the beam's weight over its position or its reaction. A factor of all coils
changes all of the model alike, and only a known mass tells. If coils and sensors stand farther out
than declared, tilts are read too large and torques are commanded too small; what tells is the
inertia of the beam at its distance from the middle, and the damping of the tilts, which is a
parameter here. Signature: that of an error of the declared weight or damping. What the records do
not separate is reported as one ambiguous effect with all its members.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import numpy as np

from .base import Array, Build, Effect, Places, Quantity, Signals, Term

_MOST = 0.5
"""Bound of a scale error: beyond, a channel's polarity or unit is wrong rather than its scale."""
_KNOWN_FORCE = "an added mass of known weight, or the stroke between the stops"


def effects(places: Places) -> list[Effect]:
    """Return scales of all sensors and all coils, and arm lengths, of a platform with a beam.

    Without a known force, as the weight of a moving beam, all of these are changes of units.
    """
    if not places.beam:
        return []
    sensors = tuple(f"sensor:{s}" for s in range(places.sensors))
    coils = places.actuators
    psi, theta, _ = places.dof
    found = [
        _effect(
            "sensor_scale", "Scale of all sensors", sensors, "reading = (1 + scale) h", _readings,
            "masses, damping and stiffness, all but weights", scales_readings=True,
        ),
        _effect(
            "coil_scale", "Scale of all coils", coils, "force = (1 + scale) F", _commands,
            "masses, damping and stiffness, all by one factor",
        ),
    ]  # fmt: skip
    for tilts, axis in (((0, 1), ""), ((0,), " along y"), ((1,), " along x")):
        where = tuple((psi, theta)[i] for i in tilts)
        suffix = "".join(f".{w}" for w in where) if axis else ""
        damping = Quantity("d", f"{places.force_unit(0)} s/{places.dof_units[0]}")
        found += [
            _effect(
                f"arm_length.both{suffix}", f"Arms of coils and sensors{axis}", where,
                "torque = (1 + arm) tau - d q', reading = h + arm (h - z)",
                partial(_arms, tilts=tilts), "inertia and stiffness of the tilts", damping,
                sensor_arms=tilts, coil_arms=tilts,
            ),
            _effect(
                f"arm_length.sensors{suffix}", f"Arms of the sensors{axis}", where,
                "reading = h + arm (h - z)",
                partial(_sensor_arms, tilts=tilts), "inertia, damping and stiffness of the tilts",
                sensor_arms=tilts,
            ),
            _effect(
                f"arm_length.coils{suffix}", f"Arms of the coils{axis}", where,
                "torque = (1 + arm) tau",
                partial(_coil_arms, tilts=tilts), "inertia, damping and stiffness of the tilts",
                coil_arms=tilts,
            ),
        ]  # fmt: skip
    return found


def _effect(
    key: str,
    title: str,
    where: tuple[str, ...],
    equation: str,
    build: Build,
    absorbed_by: str,
    *more: Quantity,
    scales_readings: bool = False,
    sensor_arms: tuple[int, ...] = (),
    coil_arms: tuple[int, ...] = (),
) -> Effect:
    """Return an effect whose first amplitude is a relative error, named as in its equation."""
    kind = key.partition(".")[0]
    error = Quantity("arm" if kind == "arm_length" else "scale", "1", -_MOST, _MOST)
    return Effect(
        key, title, kind, where, equation, (error, *more), build,
        absorbed_by=absorbed_by, told_apart_by=_KNOWN_FORCE, scales_readings=scales_readings,
        sensor_arms=sensor_arms, coil_arms=coil_arms,
    )  # fmt: skip


def _readings(signals: Signals, _shape: Sequence[float]) -> list[Term]:
    return [Term(gap=signals.q @ signals.places.sensor_shape.T)]


def _commands(signals: Signals, _shape: Sequence[float]) -> list[Term]:
    return [Term(held=signals.coil @ signals.places.coil_shape)]


def _sensor_arms(signals: Signals, _shape: Sequence[float], *, tilts: Sequence[int]) -> list[Term]:
    return [Term(gap=_tilts(signals.q, tilts) @ signals.places.sensor_shape.T)]


def _coil_arms(signals: Signals, _shape: Sequence[float], *, tilts: Sequence[int]) -> list[Term]:
    return [Term(held=_tilts(signals.coil @ signals.places.coil_shape, tilts))]


def _arms(signals: Signals, _shape: Sequence[float], *, tilts: Sequence[int]) -> list[Term]:
    held = _tilts(signals.coil @ signals.places.coil_shape, tilts)
    gap = _tilts(signals.q, tilts) @ signals.places.sensor_shape.T
    return [Term(held=held, gap=gap), Term(force=-_tilts(signals.qd, tilts))]


def _tilts(values: Array, tilts: Sequence[int]) -> Array:
    """Return values (N, n) of some tilts, zero elsewhere."""
    kept = np.zeros_like(values)
    kept[:, list(tilts)] = values[:, list(tilts)]
    return kept
