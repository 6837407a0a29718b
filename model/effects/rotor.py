"""Effects of the rotor on the beam: imbalance, weight of the unbalanced mass, reaction torque.

A mass m at radius e exerts m e (phi'^2 cos phi + phi'' sin phi) along x and m e (phi'^2 sin phi -
phi'' cos phi) along y (Genta, *Dynamics of Rotating Systems*, 2005, ch. 2). At a height over the
platform's centre these forces are torques on theta and psi; the torque of the weight rotates with
phi. Signature: a torque that follows the rotor's angle or speed. The torque of the imbalance grows
with the speed squared, that of the weight does not depend on the speed, and the reaction torque is
proportional to phi''.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import numpy as np

from .base import Array, Effect, Places, Quantity, Signals, Term, on_dof

_SPEEDS = "the rotor alone at several speeds"


def effects(places: Places) -> list[Effect]:
    """Return the rotor's effects on every DOF; empty for a plant without a beam."""
    if not places.beam:
        return []
    weight = Effect(
        "rotor.weight",
        "Weight of the rotor's unbalanced mass",
        "rotor",
        ("rotor", *places.dof[:2]),
        "torque on theta = -a cos phi + b sin phi, on psi = -a sin phi - b cos phi",
        (Quantity("a", "N m"), Quantity("b", "N m")),
        _weight,
        told_apart_by=_SPEEDS,
    )
    found = [weight]
    for i, dof in enumerate(places.dof):
        force, where = places.force_unit(i), ("rotor", dof)
        found += [
            Effect(
                "rotor.imbalance",
                "Imbalance of the rotor",
                "rotor",
                where,
                "force = a (phi'^2 cos phi + phi'' sin phi) + b (phi'^2 sin phi - phi'' cos phi)",
                (Quantity("a", f"{force} s^2"), Quantity("b", f"{force} s^2")),
                partial(_imbalance, dof=i),
                told_apart_by=_SPEEDS,
            ),
            Effect(
                "rotor.bar",
                "Reaction torque of the rotor's bar",
                "rotor",
                where,
                "force = -a phi''",
                (Quantity("a", f"{force} s^2"),),
                partial(_bar, dof=i),
                told_apart_by=_SPEEDS,
            ),
        ]
    return found


def _weight(signals: Signals, _shape: Sequence[float]) -> list[Term]:
    c, s = np.cos(signals.phi_rad), np.sin(signals.phi_rad)
    zero = np.zeros_like(c)
    return [Term(force=np.stack(columns, axis=1)) for columns in ((-s, -c, zero), (-c, s, zero))]


def _imbalance(signals: Signals, _shape: Sequence[float], *, dof: int) -> list[Term]:
    return [on_dof(signals, dof, force) for force in pushes(signals)]


def _bar(signals: Signals, _shape: Sequence[float], *, dof: int) -> list[Term]:
    return [on_dof(signals, dof, -signals.phi_rad_s2)]


def pushes(signals: Signals) -> tuple[Array, Array]:
    """Return the inertial forces (N,) along x and y of a unit mass at unit radius."""
    c, s = np.cos(signals.phi_rad), np.sin(signals.phi_rad)
    square, change = signals.phi_rad_s**2, signals.phi_rad_s2
    return square * c + change * s, square * s - change * c
