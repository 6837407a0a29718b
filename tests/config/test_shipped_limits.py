"""Test the limits of the shipped rigs: complete, in order, with margin to the sessions."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from levid.config.rig import Limits, RigConfig, load_rig
from levid.config.session import load_session
from levid.config.shipped import shipped
from levid.daemon.control.feed_forward import feed_forward
from levid.daemon.control.states import State
from levid.daemon.control.watchdog_times import expiry_warning, longest_stall, zero_after_s
from levid.daemon.loop.virtual_session import fly_virtually
from levid.log.reader import read_log
from levid.model.geometry import decoupling_matrix

RIGS = sorted(shipped("rigs/loopback.yaml").parent.glob("*.yaml"))
G_M_S2 = 9.81
CLEAR = 1.4
"""Smallest ratio of a limit to the largest value in a shipped session."""


@pytest.fixture(params=RIGS, ids=lambda path: path.stem)
def rig(request: pytest.FixtureRequest) -> RigConfig:
    return load_rig(request.param)


def at_rest_n(rig: RigConfig, beam_m: float) -> np.ndarray:
    """Return the coil forces in N at the working point."""
    T = decoupling_matrix(rig.geometry.coil_x_m, rig.geometry.coil_y_m)
    return feed_forward_wrench(rig, beam_m) @ T


def feed_forward_wrench(rig: RigConfig, beam_m: float = 0.0) -> np.ndarray:
    """Return the wrench of the feed-forward with the beam at rest."""
    return feed_forward(rig, 1 / rig.rate_hz).wrench(np.array([[beam_m, 0.0, 0.0]]))[0]


def test_all_limits_are_set(rig: RigConfig) -> None:
    derived = {"stall_s", "plane_m", "coil_follow_n", "coil_lag_s", "beam_follow_m"}  # from others
    assert {key for key in Limits.model_fields if getattr(rig.limits, key) is None} == derived


def test_platform_stays_in_range_until_amplifiers_expire_after_a_loop_failure(
    rig: RigConfig,
) -> None:
    assert not expiry_warning(rig)
    zero_s = zero_after_s(rig)
    if zero_s is not None:
        assert zero_s <= 3.0 / rig.rate_hz + 1e-9
        # Held or falling, at the acceleration of the larger of weight and force at its limit.
        weight_n = feed_forward_wrench(rig)[2]
        assert rig.limits.total_n is not None
        most_n = max(weight_n, rig.limits.total_n - weight_n)
        moved_m = 0.5 * most_n / weight_n * G_M_S2 * zero_s**2
        assert moved_m < rig.limits.gap_m
        assert longest_stall(rig) * CLEAR / rig.rate_hz <= zero_s


def test_amplifiers_that_hold_a_force_too_long_give_a_warning() -> None:
    rig = load_rig(shipped("rigs/serial.yaml"))
    slow = rig.amplifiers.model_copy(update={"expire_cycles": 20})
    warning = expiry_warning(rig.model_copy(update={"amplifiers": slow}))
    assert "21 ms" in warning
    assert "13 ms" in warning
    assert "expire_cycles to at most 12" in warning


def test_limits_are_layered(rig: RigConfig) -> None:
    limits, coils = rig.limits, len(rig.geometry.coil_x_m)
    assert limits.total_n is not None
    assert limits.coil_rms_n is not None
    assert limits.tilt_rad is not None
    assert limits.gap_m_s is not None
    weight_n = feed_forward_wrench(rig)[2]
    # Forces: the weight with as much again to accelerate it by a half, less than all coils at once.
    assert 1.5 * weight_n < limits.total_n < coils * limits.coil_n
    # Heat: a coil may carry its share for ever, the beam at the end of its way, and not its limit.
    resting_n = max(float(at_rest_n(rig, x).max()) for x in (-limits.beam_m, limits.beam_m))
    assert CLEAR * resting_n < limits.coil_rms_n <= limits.coil_n / math.sqrt(2.0)
    # A platform that tilts alone is stopped for that, before a corner is too far from its place.
    assert limits.tilt_rad * max(rig.geometry.sensors_y_m) < limits.gap_m
    # What falls onto its stops is not too fast; what is faster was thrown, or a sensor jumps.
    stops_m = 0.9e-3
    assert limits.gap_m_s > math.sqrt(2.0 * G_M_S2 * stops_m)


@pytest.mark.parametrize("name", ["trace-demo", "beam"])
def test_session_has_margin_to_the_limits(name: str, tmp_path: Path) -> None:
    file, session = shipped("rigs/loopback.yaml"), shipped(f"sessions/{name}.yaml")
    rig = load_rig(file)
    limits = rig.limits
    config = load_session(session)
    flown = fly_virtually(rig, file, config, session.read_bytes(), tmp_path / "out")
    heat_n2, keep = np.zeros(9), 1.0 - 1e-3 / limits.coil_time_constant_s
    for path in flown.logs:
        rows = read_log(path).rows
        assert not rows["saturated"].any()
        forces_n = np.abs(rows["coil_n"]).astype(float)
        assert CLEAR * forces_n.sum(axis=1).max() < limits.total_n
        for block in np.array_split(forces_n**2, max(len(rows) // 100, 1)):
            gone = keep ** len(block)
            heat_n2 = gone * heat_n2 + (1.0 - gone) * block.mean(axis=0)
            assert CLEAR**2 * heat_n2.max() < limits.coil_rms_n**2
        up = np.isin(rows["state"], (State.EXCITING, State.MOVING))
        if up.sum() < 2:
            continue
        gap_m = rows["gap_m"][up].astype(float)
        assert CLEAR * np.abs(gap_m).max() < limits.gap_m
        # Rows of a record are in a row; 1 kHz.
        assert CLEAR * 1e3 * np.abs(np.diff(gap_m, axis=0)).max() < limits.gap_m_s
        for tilt in ("psi_rad", "theta_rad"):
            assert CLEAR * np.abs(rows[tilt][up]).max() < limits.tilt_rad
