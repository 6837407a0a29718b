"""Self-test: check the readings of all channels at zero force before lift-off."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ...config.rig import RigConfig
from .control_cycle import BEAM_MARGIN_M
from .following_limits import NOISE_SHARE, coil_follow_n
from .plane_residual import plane_text, residual_projector


def self_test(rows: NDArray[np.void], rig: RigConfig) -> str:
    """Return the first implausible reading in cycle records (n,) at zero force; empty if none.

    Backends have compared limits and homed drives before. Here each channel must have responded in
    the test cycles, with a reading that a platform on its stops can cause.
    """
    bounds, geometry = rig.self_test, rig.geometry
    if not len(rows):
        return "no channel responded"
    # Sensors first: the other checks depend on them.
    gap = rows["gap_m"].astype(float)
    mean = gap.mean(axis=0)
    projector = residual_projector(geometry.sensors_x_m, geometry.sensors_y_m).projector
    residual = projector @ mean
    return (
        _first_beyond((np.abs(mean), bounds.gap_m, "sensor {} reads {:.3e} m"))
        or plane_text(residual, residual, projector, bounds.plane_m)
        or _first_beyond(
            (np.ptp(gap, axis=0), bounds.still_m, "sensor {} reading changed by {:.3e} m at rest"),
            (
                np.abs(rows["coil_readback_n"].astype(float).mean(axis=0)),
                bounds.coil_n,
                "coil {} reads back {:.3e} N at zero commanded force",
            ),
            (
                rows["coil_readback_n"].astype(float).std(axis=0),
                NOISE_SHARE * coil_follow_n(rig),
                "coil {} reads back noise of {:.3e} N rms (limits.coil_follow_n allows a fifth of "
                "it)",
            ),
            (
                np.abs(rows["beam_m"][-1:]),
                rig.limits.beam_m + BEAM_MARGIN_M,
                "the beam{} is at {:.3e} m",
            ),
            (np.abs(rows["beam_m_s"][-1:]), bounds.beam_m_s, "the beam{} moves at {:.3e} m/s"),
            (
                np.abs(rows["rotor_rad_s"][-1:]),
                bounds.rotor_rad_s,
                "the rotor{} turns at {:.3e} rad/s",
            ),
        )
    )


def _first_beyond(*tests: tuple[NDArray[np.float64], float, str]) -> str:
    """Return the message of the first test with a value above its limit; empty if there is none."""
    for value, limit, message in tests:
        if not np.all(value <= limit):  # nan is never within
            worst = int(np.nanargmax(value)) if np.isfinite(value).any() else 0
            channel = "" if message.startswith("the ") else str(worst)
            return f"{message.format(channel, value[worst])}, expected at most {limit:g}"
    return ""
