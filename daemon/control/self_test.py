"""The self-test's judgement of readings at rest: what no sound rig would say at zero force."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ...config.rig import RigConfig
from ...model.geometry import decoupling_matrix, shape_matrix
from .control_cycle import BEAM_MARGIN_M


def self_test(rows: NDArray[np.void], rig: RigConfig) -> str:
    """Return what is wrong with cycle records (n,) at zero force, in words; empty if nothing is.

    Backends have compared limits and homed drives before; here every channel has to have answered
    in the test's cycles, and its reading has to be one that a platform on its stops can give.
    """
    bounds, geometry = rig.self_test, rig.geometry
    if not len(rows):
        return "no channel answered"
    # Sensors first: what they say is what all else rests on.
    gap = rows["gap_m"].astype(float)
    at = gap.mean(axis=0)
    x, y = geometry.sensors_x_m, geometry.sensors_y_m
    plane = shape_matrix(x, y) @ decoupling_matrix(x, y)
    tests = (
        (np.abs(at), bounds.gap_m, "sensor {} reads {:.3e} m"),
        (np.abs(at - plane @ at), bounds.plane_m, "sensor {} is {:.3e} m off the others' plane"),
        (np.ptp(gap, axis=0), bounds.still_m, "sensor {} moved by {:.3e} m at rest"),
        (
            np.abs(rows["coil_readback_n"].astype(float).mean(axis=0)),
            bounds.coil_n,
            "coil {} drives {:.3e} N at zero force",
        ),
        (
            np.abs(rows["beam_m"][-1:]),
            rig.limits.beam_m + BEAM_MARGIN_M,
            "beam{}: it is at {:.3e} m",
        ),
        (np.abs(rows["beam_m_s"][-1:]), bounds.beam_m_s, "beam{}: it moves at {:.3e} m/s"),
        (np.abs(rows["rotor_rad_s"][-1:]), bounds.rotor_rad_s, "rotor{}: turns at {:.3e} rad/s"),
    )
    for found, most, words in tests:
        if not np.all(found <= most):  # nan is never within
            worst = int(np.nanargmax(found)) if np.isfinite(found).any() else 0
            name = "" if "{}:" in words else str(worst)
            return f"{words.format(name, found[worst])}, expected at most {most:g}"
    return ""
