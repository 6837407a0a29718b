"""Undeclared forces of the moving beam on the platform: weight, reaction, Coriolis, cable, chain.

The beam's weight acts on theta, its acceleration reacts at the arm z_b, and its speed couples tilt
and lift (Coriolis). A skew guide or a wrong encoder scale changes each of these three forces
separately (Gajdusek, Damen, Van den Bosch, eqs. (1) to (6)). The pull of a cable from the frame
depends on the beam's position, the friction of a chain on its direction of motion. Signature: a
force that follows x_b, v_b or a_b without other excitation; slow sweeps of the beam show the
dependence on position, fast ones that on speed and acceleration.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

import numpy as np

from .base import Array, Effect, Places, Quantity, Signals, Term, on_dof

_SLOW_M_S = 2e-3
_SWEEPS = "beam sweeps at several speeds"


def effects(places: Places) -> list[Effect]:
    """Return the beam's effects on every DOF; empty for a plant without a beam."""
    if not places.beam:
        return []
    _, theta, z = places.dof
    found = [
        _effect("beam_motion.gravity", "Error in the declared weight of the beam", "beam_motion",
                theta, "torque = -a x_b", ("a", "N"), partial(_on, dof=1, of=_position),
                "beam mass, within the limits that its inertia sets"),
        _effect("beam_motion.coriolis_tilt", "Error in the declared Coriolis torque", "beam_motion",
                theta, "torque = -2 a x_b v_b theta'", ("a", "kg"),
                partial(_on, dof=1, of=_coriolis_tilt)),
        _effect("beam_motion.coriolis_lift", "Error in the declared Coriolis force", "beam_motion",
                z, "force = -2 a v_b theta'", ("a", "kg"), partial(_on, dof=2, of=_coriolis_lift)),
        _effect("beam_motion.euler_lift",
                "Error in the declared force of the beam's acceleration on the tilted platform",
                "beam_motion", z, "force = -a a_b theta", ("a", "kg"),
                partial(_on, dof=2, of=_euler_lift)),
    ]  # fmt: skip
    for i, dof in enumerate(places.dof):
        force = places.force_unit(i)
        found.append(
            _effect("beam_motion.reaction", "Error in the declared reaction to the beam's "
                    "acceleration", "beam_motion", dof, "force = a a_b", ("a", f"{force} s^2/m"),
                    partial(_on, dof=i, of=_acceleration),
                    "beam height, within the limits that its inertia sets" if dof == theta else "")
        )  # fmt: skip
        found += [
            # On theta the equation equals that of the beam's weight: the two are alternatives.
            _effect("cable_pull.linear", "Pull of a cable to the beam", "external_field", dof,
                    "force = -a x_b", ("a", f"{force}/m"), partial(_on, dof=i, of=_position),
                    "weight of the beam" if dof == theta else "a skew guide"),
            _effect("cable_pull.quadratic", "Pull of a cable, symmetric about the middle",
                    "external_field", dof, "force = -b x_b^2", ("b", f"{force}/m^2"),
                    partial(_on, dof=i, of=_position_squared)),
            Effect(
                "friction.beam_chain",
                "Friction of a chain between beam and frame",
                "friction",
                (dof,),
                "force = friction tanh(v_b / 2 mm/s) + d v_b",
                (Quantity("friction", force), Quantity("d", f"{force} s/m")),
                partial(_chain, dof=i),
                told_apart_by=_SWEEPS,
            ),
        ]  # fmt: skip
    return found


def _effect(
    key: str,
    title: str,
    effect_class: str,
    dof: str,
    equation: str,
    amplitude: tuple[str, str],
    build: Callable[[Signals, Sequence[float]], list[Term]],
    absorbed_by: str = "",
) -> Effect:
    return Effect(
        key, title, effect_class, (dof,), equation, (Quantity(*amplitude),), build,
        absorbed_by=absorbed_by, told_apart_by=_SWEEPS,
    )  # fmt: skip


def _on(
    signals: Signals, _shape: Sequence[float], *, dof: int, of: Callable[[Signals], Array]
) -> list[Term]:
    return [on_dof(signals, dof, of(signals))]


def _position(s: Signals) -> Array:
    return -s.x_b_m


def _position_squared(s: Signals) -> Array:
    return -(s.x_b_m**2)


def _acceleration(s: Signals) -> Array:
    return s.a_b_m_s2


def _coriolis_tilt(s: Signals) -> Array:
    return np.asarray(-2 * s.x_b_m * s.v_b_m_s * s.qd[:, 1])


def _coriolis_lift(s: Signals) -> Array:
    return np.asarray(-2 * s.v_b_m_s * s.qd[:, 1])


def _euler_lift(s: Signals) -> Array:
    return np.asarray(-s.a_b_m_s2 * s.q[:, 1])


def _chain(signals: Signals, _shape: Sequence[float], *, dof: int) -> list[Term]:
    v = signals.v_b_m_s
    return [on_dof(signals, dof, np.tanh(v / _SLOW_M_S)), on_dof(signals, dof, v)]
