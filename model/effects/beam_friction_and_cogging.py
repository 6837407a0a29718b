"""Effects in the beam's drives: friction, presliding in the bearing, cogging of the linear motors.

Forces between beam and platform are internal: they appear in the drives' force, and act on the
platform only through the beam's motion, which is measured. Cogging is periodic with the magnets'
pitch (Zhu and Howe, *Influence of design parameters on cogging torque in permanent magnet
machines*, IEEE Trans. Energy Conversion 15, 2000). A bearing's balls deform elastically before they
roll, so a beam that the drives hold on a tilting platform shifts with hysteresis. Signature:
cogging depends on the beam's position only, not on its speed or direction; friction has the sign of
the beam's speed; presliding follows the tilt while the beam is at rest.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from .base import Array, Effect, Places, Quantity, Signals, Term
from .lag_and_hysteresis_recursions import dahl
from .operating_range import Extent

_PITCH_M = (5e-3, 60e-3)
_APART = 1.2
"""Difference of neighbouring grid pitches, in cycles over the travel; less is not resolvable."""
_BREAK_AWAY_M = (1e-5, 1e-4)


def effects(places: Places, extent: Extent) -> list[Effect]:
    """Return friction and cogging of the beam's drives; empty for a plant without a beam."""
    if not places.beam:
        return []
    sliding = Effect(
        "friction.beam",
        "Friction of the beam's guide",
        "friction",
        ("beam",),
        "drive force = friction tanh(v_b / v_s)",
        (Quantity("friction", "N", 0.0),),
        _sliding,
        (Quantity("v_s", "m/s", 1e-5, 0.1, log=True),),
        ((1e-3,),),
        absorbed_by="the part proportional to the speed: a delay of the drives' readings",
        told_apart_by="beam sweeps at several speeds",
    )
    presliding = Effect(
        "friction.beam_presliding",
        "Presliding of the beam in its bearing",
        "friction",
        ("beam",),
        "drive force = friction f, df = (1 - f sign dx_b) dx_b / x_s",
        (Quantity("friction", "N", 0.0),),
        _presliding,
        (Quantity("x_s", "m", 1e-7, 1e-2, log=True),),
        tuple((x,) for x in _BREAK_AWAY_M),
        told_apart_by="small slow motions of the beam",
    )
    reach = extent.reach[1]
    tilting = Effect(
        "friction.beam_tilt",
        "Presliding of the beam as the platform tilts",
        "friction",
        ("beam", places.dof[1]),
        "drive force = friction f, torque = -a f, df = (1 - f sign dtheta) dtheta / theta_s",
        (Quantity("friction", "N", 0.0), Quantity("a", "N m", 0.0)),
        _tilting,
        (Quantity("theta_s", "rad", 1e-3 * reach, 10 * reach, log=True),),
        ((0.2 * reach,), (reach,)),
        absorbed_by="without slip: stiffness of theta",
        told_apart_by="tilt excitation while the beam is at rest",
    )
    pitches = _grid(max(extent.beam_m, 0.05))
    return [sliding, presliding, tilting, cogging(*pitches)]


def cogging(*pitches_m: float) -> Effect:
    """Return the cogging effect with start values of the pitch in m."""
    return Effect(
        "cogging",
        "Cogging of the beam's linear motors",
        "cogging",
        ("beam",),
        "drive force = a cos(2 pi x_b / pitch) + b sin(2 pi x_b / pitch)",
        (Quantity("a", "N"), Quantity("b", "N")),
        _cogging,
        (Quantity("pitch", "m", 0.5 * _PITCH_M[0], 2 * _PITCH_M[1], log=True),),
        tuple((p,) for p in pitches_m),
        told_apart_by="slow beam sweeps in both directions",
    )


def _grid(travel_m: float) -> Array:
    low, high = 1 / _PITCH_M[1], 1 / _PITCH_M[0]
    return np.asarray(1 / np.linspace(low, high, 1 + round((high - low) * travel_m / _APART)))


def _sliding(signals: Signals, shape: Sequence[float]) -> list[Term]:
    return [Term(drive=np.tanh(signals.v_b_m_s / shape[0]))]


def _presliding(signals: Signals, shape: Sequence[float]) -> list[Term]:
    return [Term(drive=dahl(signals.x_b_m, shape[0], signals.Ts_s))]


def _tilting(signals: Signals, shape: Sequence[float]) -> list[Term]:
    f = dahl(signals.q[:, 1], shape[0], signals.Ts_s)
    force = np.zeros_like(signals.q)
    force[:, 1] = -f
    return [Term(drive=f), Term(force=force)]


def _cogging(signals: Signals, shape: Sequence[float]) -> list[Term]:
    angle = 2 * np.pi / shape[0] * signals.x_b_m
    return [Term(drive=np.cos(angle)), Term(drive=np.sin(angle))]
