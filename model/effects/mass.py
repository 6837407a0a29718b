"""Undeclared mass: offset of the centre of mass, payload, pose-dependent inertia.

A centre of mass at (x, y) couples lift and tilt through the acceleration (Newton-Euler equations
about the geometric centre); its weight is a constant torque. A payload adds such a coupling and
torque from the moment it is put on; its weight is a step of the vertical force. Pose-dependent
inertia follows from Lagrange's equation (Goldstein, *Classical Mechanics*, ch. 1). Signature: a
force proportional to accelerations, which grows with frequency squared; for a payload also the
lasting step of force. Coupling by rods does not grow with frequency.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from itertools import pairwise

import numpy as np

from .base import Array, Effect, Places, Quantity, Signals, Term, on_dof
from .operating_range import Extent

_TIMES = 9
_MOST_TIMES = 48
_APART_S = 6.0
"""Distance of start times. From a start farther away the fit does not converge to the payload's
time: between the two times the force is wrong."""
_RISE = 0.5
"""Rise time of the start values over the distance of start times."""
_SHORTEST_S = 0.01


def effects(places: Places, extent: Extent) -> list[Effect]:
    """Return centre-of-mass offsets and payload for the rig, else pose-dependent inertia."""
    if not places.beam:
        return _inertia(places)
    return [*_offsets(places), payload(places, _cut(extent.spans_s or _parts(places.span_s)))]


def payload(places: Places, spans_s: Sequence[tuple[float, float]]) -> Effect:
    """Return a payload effect; start values: the middle of each time span and of the platform.

    The start values have a slow rise, so that a fit converges from seconds away.
    """
    reach = float(np.abs(places.sensor_xy_m).max())
    return Effect(
        "payload",
        "Payload",
        "payload",
        places.dof,
        "force = -m s (g + s^T q'') from time on, within rise; s = [y, x, 1]",
        (Quantity("m", "kg"),),
        _payload,
        (
            Quantity("time", "s", *places.span_s),
            Quantity("rise", "s", _SHORTEST_S, 60.0, log=True),
            Quantity("x", "m", -2 * reach, 2 * reach),
            Quantity("y", "m", -2 * reach, 2 * reach),
        ),
        tuple((0.5 * (begin + end), _RISE * (end - begin), 0.0, 0.0) for begin, end in spans_s),
        absorbed_by="between records: the records' constant forces, and masses",
        told_apart_by="a record in which the payload changes",
    )


def _offsets(places: Places) -> list[Effect]:
    _, _, z = places.dof
    return [
        Effect(
            "centre_of_mass",
            f"Offset of the centre of mass along {axis}",
            "centre_of_mass",
            (places.dof[tilt], z),
            f"torque = -a z'', force = -a {places.dof[tilt]}''; a = mass times {axis}",
            (Quantity("a", "kg m"),),
            partial(_offset, tilt=tilt),
            absorbed_by="offset along x: the beam's zero position; weight: constant torque",
            told_apart_by="excitation of lift and tilt in one record",
        )
        for tilt, axis in ((0, "y"), (1, "x"))
    ]


def _parts(span_s: tuple[float, float]) -> list[tuple[float, float]]:
    edges = np.linspace(*span_s, _TIMES + 1).tolist()
    return list(pairwise(edges))


def _cut(spans_s: Sequence[tuple[float, float]]) -> list[tuple[float, float]]:
    """Return the spans divided into equal parts of about _APART_S, at most about _MOST_TIMES."""
    apart_s = max(_APART_S, sum(end - begin for begin, end in spans_s) / _MOST_TIMES)
    parts = []
    for begin, end in spans_s:
        edges = np.linspace(begin, end, max(round((end - begin) / apart_s), 1) + 1)
        parts += list(pairwise(edges.tolist()))
    return parts


def _inertia(places: Places) -> list[Effect]:
    found = []
    for i, (dof, unit) in enumerate(zip(places.dof, places.dof_units, strict=True)):
        force = places.force_unit(i)
        for power, equation in (
            (1, "force = -m1 (q q'' + q'^2 / 2)"),
            (2, "force = -m2 (q^2 q'' + q q'^2)"),
        ):
            found.append(
                Effect(
                    ("inertia.linear", "inertia.quadratic")[power - 1],
                    f"Inertia {('linear', 'quadratic')[power - 1]} in the position",
                    "inertia",
                    (dof,),
                    equation,
                    (Quantity(f"m{power}", f"{force} s^2/{unit}^{power + 1}"),),
                    partial(_changing, dof=i, power=power),
                    absorbed_by="the part independent of the position: the declared mass",
                    told_apart_by="excitation at low and at high frequencies",
                )
            )
    return found


def _offset(signals: Signals, _shape: Sequence[float], *, tilt: int) -> list[Term]:
    force = np.zeros_like(signals.q)
    force[:, tilt] = -signals.qdd[:, 2]
    force[:, 2] = -signals.qdd[:, tilt]
    return [Term(force=force)]


def _payload(signals: Signals, shape: Sequence[float]) -> list[Term]:
    time_s, rise_s, x, y = shape
    s = np.array([y, x, 1.0])
    share = 0.5 * (1 + np.tanh(2 * (signals.time_s - time_s) / rise_s))
    acceleration = s[0] * signals.qdd[:, 0] + s[1] * signals.qdd[:, 1] + signals.qdd[:, 2]
    weight: Array = -share * (signals.gravity_m_s2 + acceleration)
    return [Term(force=weight[:, None] * s)]


def _changing(signals: Signals, _shape: Sequence[float], *, dof: int, power: int) -> list[Term]:
    q, qd, qdd = signals.q[:, dof], signals.qd[:, dof], signals.qdd[:, dof]
    if power == 1:
        return [on_dof(signals, dof, -(q * qdd + 0.5 * qd * qd))]
    return [on_dof(signals, dof, -(q * q * qdd + q * qd * qd))]
