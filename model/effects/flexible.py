"""Flexible modes: bending modes of the platform, and a mass on a spring on one DOF.

A bending mode obeys eta'' + 2 zeta w eta' + w^2 eta = phi^T F / m; the readings contain phi eta in
addition to the pose (Preumont, *Vibration Control of Active Structures*, 2018, ch. 2). The mode is
orthogonal to the rigid motions. If coils and sensors are in the same places, only forces of single
coils excite a mode, and the mode appears only in the non-rigid part of the readings. A mode with a
rigid part in its pattern also acts on the pose. A mass on a spring adds the force m (w^2 x + 2 zeta
w x') to one DOF; x is its deflection. Signature: a resonance, or a compliance below its frequency,
with one pattern over all sensors. A faulty sensor affects one reading and has no resonance.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from itertools import product

import numpy as np

from .base import Array, Effect, Placed, Places, Quantity, Signals, Term, on_dof
from .lag_and_hysteresis_recursions import oscillator, smooth_oscillator
from .operating_range import Extent
from .point_force_conversion import forces

LOOSE_MASS = "flexible_mode.loose_mass"
PATTERNS = ("twist", "saddle", "dome", "wave_x", "wave_y", "egg_box")
_RIGID = ("rigid_1", "rigid_2", "rigid_3")
_MODES_HZ = (25.0, 45.0, 80.0, 140.0, 280.0)
_HIGHER_HZ = (45.0, 110.0, 280.0)
_HIGHER = ("wave_x", "wave_y", "egg_box")
"""Patterns that are rarely the first bending mode of a plate."""
LOOSE_HZ = (7.5, 15.0, 30.0, 60.0)
LOWEST_HZ = 5.0
DAMPING_START = 0.08
"""Damping ratio to start from, so large that neighbouring grid frequencies overlap."""


def effects(places: Places, extent: Extent) -> list[Effect]:
    """Return a bending mode for each base pattern, and a mass on a spring for each DOF.

    A DOF that is not the rig's may have another one.
    """
    number = 1 if places.beam else 2
    found = _modes(places, extent)
    for (i, dof), at in product(enumerate(places.dof), range(number)):
        found.append(
            Effect(
                LOOSE_MASS + (".another" if at else ""),
                "Another mass on a spring" if at else "Mass on a spring",
                "flexible_mode",
                (dof,),
                "force = m (w^2 x + 2 zeta w x'), x'' + 2 zeta w x' + w^2 x = -q''; "
                "w = 2 pi frequency, zeta = damping",
                (Quantity("m", f"{places.force_unit(i)} s^2/{places.dof_units[i]}", 0.0),),
                partial(_loose_mass, dof=i),
                resonance(LOWEST_HZ if places.beam else extent.slowest_hz),
                (
                    *((f, DAMPING_START) for f in _loose_hz(places, extent)),
                    *((f, zeta) for of, f, zeta in extent.dof_resonances if of == i),
                ),
                absorbed_by="far below its frequency: mass",
                told_apart_by="excitation up to its frequency",
                beside=LOOSE_MASS if at else "",
            )
        )
    return found


def sites(placed: Placed, places: Places) -> tuple[str, ...]:
    """Return coils and sensors with at least half of a bending mode's largest deflection."""
    names, over_sensors, over_coils = patterns(places)
    name = placed.effect.key.removeprefix("flexible_mode.")
    if name not in names:
        return placed.effect.where
    shares = np.insert(np.asarray(placed.shape[2:], float), names.index(name), 1.0)
    found: list[str] = []
    for kind, over in (("coil", over_coils), ("sensor", over_sensors)):
        moves = np.abs(over @ shares)
        found += [f"{kind}:{i}" for i in np.flatnonzero(moves > 0.5 * moves.max()).tolist()]
    return tuple(found)


def patterns(places: Places) -> tuple[tuple[str, ...], Array, Array]:
    """Return names and shapes of patterns at sensors (S, P) and coils (C, P), rigid ones first.

    The patterns are polynomials in x and y, orthonormalised over the sensors in this order; their
    number is at most that of the sensors. Empty if the sensors' positions are unknown.
    """
    if len(places.sensor_xy_m) < 4:
        return (), np.zeros((places.sensors, 0)), np.zeros((places.coils, 0))
    size = np.abs(places.sensor_xy_m).max()
    at_sensors, at_coils = (
        _polynomials(xy / size) for xy in (places.sensor_xy_m, places.coil_xy_m)
    )
    names: list[str] = []
    kept: list[Array] = []
    kept_coils: list[Array] = []
    for name, s, c in zip((*_RIGID, *PATTERNS), at_sensors.T, at_coils.T, strict=True):
        new, new_coils = s.copy(), c.copy()
        for known, known_coils in zip(kept, kept_coils, strict=True):
            share = known @ new
            new, new_coils = new - share * known, new_coils - share * known_coils
        length = np.linalg.norm(new)
        if length > 1e-6 * np.linalg.norm(s):
            names.append(name)
            kept.append(new / length)
            kept_coils.append(new_coils / length)
    return tuple(names), np.stack(kept, axis=1), np.stack(kept_coils, axis=1)


def _polynomials(xy: Array) -> Array:
    x, y = xy.T
    return np.stack(
        [np.ones_like(x), x, y, x * y, x * x - y * y, x * x + y * y, x * y * y, x * x * y,
         x * x * y * y], axis=1,
    )  # fmt: skip


def _loose_hz(places: Places, extent: Extent) -> tuple[float, ...]:
    """Return start frequencies of a mass on a spring: all that the records can show."""
    return LOOSE_HZ if places.beam else extent.resonance_starts_hz() or LOOSE_HZ


def resonance(lowest_hz: float = LOWEST_HZ) -> tuple[Quantity, Quantity]:
    """Return frequency and damping ratio of what vibrates."""
    return (
        Quantity("frequency", "Hz", lowest_hz, 1000.0, log=True),
        Quantity("damping", "1", 1e-3, 0.7, log=True),
    )


def _modes(places: Places, extent: Extent) -> list[Effect]:
    names, _, _ = patterns(places)
    found = []
    for i, name in enumerate(names):
        if name in _RIGID:
            continue
        others = tuple(other for other in names if other != name)
        found.append(
            Effect(
                f"flexible_mode.{name}",
                f"Bending mode, mostly {name.replace('_', ' ')}",
                "flexible_mode",
                (),
                "reading = h + phi eta, eta'' + 2 zeta w eta' + w^2 eta = phi^T F / m; "
                "w = 2 pi frequency, zeta = damping, phi = this pattern + shares of the others",
                (Quantity("per_mass", "1/kg", 0.0),),
                partial(_mode, base=i),
                (*resonance(), *(Quantity(other, "1", -3.0, 3.0) for other in others)),
                tuple((*start, *(0.0 for _ in others)) for start in _starts(name, extent)),
                absorbed_by="not visible without excitation of single coils",
                told_apart_by="excitation of the coils one by one, up to its frequency",
            )
        )
    return found


def _starts(name: str, extent: Extent) -> list[tuple[float, float]]:
    """Return start values of frequency and damping: a grid, and those seen in the readings."""
    seen = [(f_hz, zeta) for pattern, f_hz, zeta in extent.resonances if pattern == name]
    return [(f_hz, DAMPING_START) for f_hz in (_HIGHER_HZ if name in _HIGHER else _MODES_HZ)] + seen


def _mode(signals: Signals, shape: Sequence[float], *, base: int) -> list[Term]:
    _, over_sensors, over_coils = patterns(signals.places)
    shares = np.insert(np.asarray(shape[2:], float), base, 1.0)
    drive = forces(delayed(signals), (over_coils @ shares)[:, None])[:, 0]
    eta = oscillator(drive, shape[0], shape[1], signals.Ts_s, signals.lag_s)[:, 0]
    return [Term(gap=np.outer(eta, over_sensors @ shares))]


def delayed(signals: Signals) -> Array:
    """Return the commands (N, C) that act in the period after each row."""
    return signals.coil[np.maximum(np.arange(signals.rows) - signals.delay_cycles, 0)]


def _loose_mass(signals: Signals, shape: Sequence[float], *, dof: int) -> list[Term]:
    q, qd = signals.q[:, dof], signals.qd[:, dof]
    return [on_dof(signals, dof, pull_of_mass(q, qd, shape[0], shape[1], signals.Ts_s))]


def pull_of_mass(
    q: Array, qd: Array, frequency_hz: float, damping: float, Ts_s: float, slowing: float = 0.0
) -> Array:
    """Return the force (N,) of a unit mass on a spring on the DOF that it hangs on.

    slowing: by how much of its speed bearings in the frame slow it down in a second. It starts with
    the speed of the DOF.
    """
    w = 2.0 * np.pi * frequency_hz
    stiff, damp = w * w, 2.0 * damping * w
    # Of its position p: p'' + (damp + slowing) p' + stiff p = stiff q + damp q'. What is solved is
    # its way from a uniform motion with the first speed.
    x = q - q[0] - qd[0] * Ts_s * np.arange(len(q))
    drive = stiff * x + damp * (qd - qd[0]) - slowing * qd[0]
    p = smooth_oscillator(drive, frequency_hz, damping + 0.5 * slowing / w, Ts_s)
    return np.asarray(stiff * (p[:, 0] - x) + damp * (p[:, 1] - qd + qd[0]))
