"""What the moving beam does to the platform beyond what is declared of it.

The beam's weight tilts the platform about theta, its acceleration pushes back at the arm z_b, its
speed turns tilt into lift (Coriolis); a guide that is skew or an encoder of a wrong scale changes
each by itself (Gajdusek, Damen, Van den Bosch, eqs. (1) to (6)). A cable from the frame pulls by
where the beam is, a chain by where it goes. Signature: follows x_b, v_b or a_b when nothing else is
excited; slow sweeps show the place, fast ones speed and acceleration.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

import numpy as np

from .base import Array, Effect, Places, Quantity, Signals, Term, on_dof

_SLOW_M_S = 2e-3
_SWEEPS = "beam sweeps at several speeds"


def effects(places: Places) -> list[Effect]:
    """Return what the rig's beam may do on every DOF; nothing where there is no beam."""
    if not places.beam:
        return []
    _, theta, z = places.dof
    found = [
        _one("beam_motion.gravity", "Weight of the beam, declared wrongly", "beam_motion", theta,
             "torque = -a x_b", ("a", "N"), partial(_on, dof=1, of=_place),
             "mass of the beam, as far as its inertia allows"),
        _one("beam_motion.coriolis_tilt", "Coriolis torque, declared wrongly", "beam_motion", theta,
             "torque = -2 a x_b v_b theta'", ("a", "kg"), partial(_on, dof=1, of=_coriolis_tilt)),
        _one("beam_motion.coriolis_lift", "Coriolis force, declared wrongly", "beam_motion", z,
             "force = -2 a v_b theta'", ("a", "kg"), partial(_on, dof=2, of=_coriolis_lift)),
        _one("beam_motion.euler_lift", "Force of the tilting beam's acceleration, declared wrongly",
             "beam_motion", z, "force = -a a_b theta", ("a", "kg"),
             partial(_on, dof=2, of=_euler_lift)),
    ]  # fmt: skip
    for i, dof in enumerate(places.dof):
        force = places.force_unit(i)
        found.append(
            _one("beam_motion.reaction", "Reaction of the beam's acceleration, declared wrongly",
                 "beam_motion", dof, "force = a a_b", ("a", f"{force} s^2/m"),
                 partial(_on, dof=i, of=_acceleration),
                 "arm of the beam, as far as its inertia allows" if dof == theta else "")
        )  # fmt: skip
        found += [
            # On theta it is what the beam's weight is, too: each is an alternative of the other.
            _one("cable_pull.linear", "Pull of a cable to the beam", "external_field", dof,
                 "force = -a x_b", ("a", f"{force}/m"), partial(_on, dof=i, of=_place),
                 "weight of the beam" if dof == theta else "a guide that is skew"),
            _one("cable_pull.quadratic", "Pull of a cable that stretches to both sides",
                 "external_field", dof, "force = -b x_b^2", ("b", f"{force}/m^2"),
                 partial(_on, dof=i, of=_place_squared)),
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


def _one(
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


def _place(s: Signals) -> Array:
    return -s.x_b_m


def _place_squared(s: Signals) -> Array:
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
