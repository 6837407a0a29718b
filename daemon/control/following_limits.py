"""Derive by how much coil forces and drives may deviate from their commands, from the rig."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ...config.rig import RigConfig
from ...model.geometry import shape_matrix
from .feed_forward import FeedForwardLaw, feed_forward

if TYPE_CHECKING:
    from .following_check import FollowingCheck

Array = NDArray[np.float64]

COIL_READINGS = 3
"""Deviating readings in a row that make a coil's fault. One may be a defect of the transmission."""
_COIL_SHARE = 0.025
"""Default of `limits.coil_follow_n` over `limits.coil_n`: 0.5 N of 20 N."""
NOISE_SHARE = 0.2
"""Largest standard deviation of the readback over `coil_follow_n`. Gaussian noise exceeds five
standard deviations with probability 6e-7, and in three readings in a row with 2e-19: at 10 kHz with
nine coils once in 2e6 years."""
_LEAST_LAG_S, _TIMES_LAG = 1e-3, 2.0
_GAP_SHARE = 0.1
"""Share of `limits.gap_m` that an unknown displacement of the beam may use up."""
_LEAST_BEAM_M, _MOST_BEAM_M = 1e-4, 2e-3
"""Bounds of the derived limit: position loops settle within the first; the second is the overshoot
of the beam beyond its range that is no fault."""


def coil_follow_n(rig: RigConfig) -> float:
    """Return by how much a coil's readback may deviate from its command, in N."""
    return rig.limits.coil_follow_n or _COIL_SHARE * rig.limits.coil_n


def coil_lag_s(rig: RigConfig, law: FeedForwardLaw) -> float:
    """Return the longest time constant of the amplifiers in s: twice the model's, at least 1 ms."""
    return rig.limits.coil_lag_s or max(_TIMES_LAG * law.lag_s, _LEAST_LAG_S)


def beam_follow_m(rig: RigConfig, law: FeedForwardLaw) -> float:
    """Return by how much the beam may deviate from its setpoint, in m.

    A displacement dx that is not known turns the platform by m_b g dx / kp until the integral
    action has removed it. At the outermost sensor this may be a tenth of `limits.gap_m`.
    """
    if rig.limits.beam_follow_m is not None:
        return rig.limits.beam_follow_m
    geometry = rig.geometry
    S = np.abs(shape_matrix(geometry.sensors_x_m, geometry.sensors_y_m))
    kp = np.array(rig.control.kp)
    tilt_per_m = np.divide(np.abs(law.per_beam_m), kp, out=np.zeros(3), where=kp > 0.0)
    gap_per_m = float((S @ tilt_per_m).max())
    derived = _GAP_SHARE * rig.limits.gap_m / gap_per_m if gap_per_m > 0.0 else math.inf
    return min(max(derived, _LEAST_BEAM_M), _MOST_BEAM_M)


def off_target(row: NDArray[np.void], rig: RigConfig) -> str:
    """Return which drive a log row (scalar) shows away from its setpoint; empty if none."""
    law = feed_forward(rig, 1.0 / rig.rate_hz)
    for what, at, to, limit in (
        ("the beam is at {:.5f} m, its target is {:.5f} m", row["beam_m"], row["beam_ref_m"],
         beam_follow_m(rig, law)),
        ("the rotor is at {:.4f} rad, its target is {:.4f} rad", row["rotor_rad"],
         row["rotor_ref_rad"], rig.limits.rotor_follow_rad),
    ):  # fmt: skip
        if not abs(at - to) <= limit:
            return what.format(at, to)
    return ""


def following_check(
    rig: RigConfig, law: FeedForwardLaw, period_s: float, memory: Array
) -> FollowingCheck:
    """Return the check of a rig's coils and drives, which keeps its state in `memory`.

    A drive must deviate for as long as its time constant before it is a fault.
    """
    from .following_check import FollowingCheck  # compiled: the supervisor does without

    coils, limits = len(rig.geometry.coil_x_m), rig.limits
    drive_readings = max(math.ceil(limits.drive_lag_s / period_s), COIL_READINGS)
    return FollowingCheck(
        memory,
        np.array([*[coil_follow_n(rig)] * coils, beam_follow_m(rig, law), limits.rotor_follow_rad]),
        np.array([*[coil_lag_s(rig, law)] * coils, limits.drive_lag_s, limits.drive_lag_s]),
        np.array([*[COIL_READINGS] * coils, drive_readings, drive_readings]),
        period_s,
    )
