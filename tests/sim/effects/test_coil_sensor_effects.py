"""Test the shipped effects at coils and sensors, and the flexible mode."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from effect_test_helpers import DT_S as DT
from effect_test_helpers import R_M as R
from effect_test_helpers import fresh
from numpy.typing import NDArray
from scipy.signal import lsim, lti

from levid.sim.effects.coils import CoilGain, DeadZone, ForceConstant, ForceOffset, SoftSaturation
from levid.sim.effects.flexible import SHAPES, FlexibleMode
from levid.sim.effects.lags import ActuatorLag, ExtraDelay, ThermalDrift
from levid.sim.effects.mains import MainsPickup
from levid.sim.effects.sensor_memory import SensorDrift, SensorLag, StickingSensor, StuckSensor
from levid.sim.effects.sensors import SensorCrosstalk, SensorGain, SensorNonlinearity

Array = NDArray[np.float64]
LEVEL = np.zeros(3)


def given(effect: Any, force_n: Array, q: Array = LEVEL) -> Array:
    """Return the delivered forces (n, 9) for the same `force_n` (n,) at every coil."""
    return np.array(
        [effect.coil_force(i * DT, q, np.full(9, f)) for i, f in enumerate(np.atleast_1d(force_n))]
    )


def seen(effect: Any, gap_m: Array) -> Array:
    """Return the measured gaps (n, 9) for the same `gap_m` (n,) at every sensor."""
    return np.array([effect.gap(i * DT, np.full(9, g)) for i, g in enumerate(np.atleast_1d(gap_m))])


def only(channel: int, values: Array, others: Array) -> None:
    """Assert that the other eight channels are unchanged."""
    np.testing.assert_array_equal(
        np.delete(values, channel, axis=1), np.repeat(others[:, None], 8, axis=1)
    )


FORCES = np.linspace(-20, 20, 41)


@pytest.mark.parametrize(
    ("effect", "curve"),
    [
        (CoilGain(3, 0.02), lambda f: 1.02 * f),
        (ForceOffset(3, -0.1), lambda f: f - 0.1),
        (DeadZone(3, 0.5), lambda f: np.sign(f) * np.maximum(np.abs(f) - 0.5, 0)),
        (SoftSaturation(3, 10.0, 1.0), lambda f: f / (1 + np.abs(f) / 10)),
        (SoftSaturation(3, 10.0, 4.0), lambda f: f / (1 + (f / 10) ** 4) ** 0.25),
        (SoftSaturation(3, 0.9, 2000.0), lambda f: np.clip(f, -0.9, 0.9)),
    ],
)
def test_effect_changes_one_coil_only(effect, curve) -> None:
    force = given(fresh(effect), FORCES)
    np.testing.assert_allclose(force[:, 3], curve(FORCES), rtol=1e-12, atol=1e-15)
    only(3, force, FORCES)


def test_all_coils_means_each() -> None:
    force = given(fresh(CoilGain("all", -0.01)), FORCES)
    np.testing.assert_allclose(force, 0.99 * np.repeat(FORCES[:, None], 9, axis=1))


def test_force_constant_is_that_of_the_coil_s_own_height() -> None:
    q = np.array([2e-3, -1e-3, 3e-4])
    force = given(fresh(ForceConstant("all", -20.0, -1e4)), np.array([7.0]), q)[0]
    grid = np.array([1, 0, -1]) * R
    h = np.array([q[2] + y * q[0] + x * q[1] for x in grid for y in grid])
    np.testing.assert_allclose(force, 7 * (1 - 20 * h - 1e4 * h**2), rtol=1e-12)


def test_lag_is_the_mean_of_a_first_order_response() -> None:
    """Steps of 1 N each: exact means over the step of 1 - exp(-t / tau), from its integral."""
    tau = 4e-4
    force = given(fresh(ActuatorLag(5, tau)), np.ones(40))
    edges = np.arange(41) * DT
    integral = edges + tau * np.exp(-edges / tau)
    np.testing.assert_allclose(force[:, 5], np.diff(integral) / DT, rtol=1e-9)
    only(5, force, np.ones(40))


@pytest.mark.parametrize(("delay_s", "whole", "part"), [(3e-4, 3, 0.0), (2.5e-4, 2, 0.5)])
def test_delay_moves_and_splits(delay_s: float, whole: int, part: float) -> None:
    force_n = np.random.default_rng(3).standard_normal(50)
    force = given(fresh(ExtraDelay(7, delay_s)), force_n)[:, 7]
    early, late = force_n[10 - whole : 50 - whole], force_n[9 - whole : 49 - whole]
    np.testing.assert_allclose(force[10:], (1 - part) * early + part * late, atol=1e-12)


def test_zero_delay_changes_nothing() -> None:
    np.testing.assert_array_equal(given(fresh(ExtraDelay("all", 0.0)), FORCES)[:, 0], FORCES)


def test_coil_warms_with_its_force_squared() -> None:
    """After one time constant 1 - 1/e of loss (F / F_rated)^2; the forward rule is exact here."""
    force = given(
        fresh(ThermalDrift(1, loss=0.1, rated_n=8.0, time_constant_s=0.5)), np.full(5000, 4.0)
    )
    assert force[-1, 1] == pytest.approx(4 * (1 - 0.1 * 0.25 * (1 - np.exp(-1))), rel=1e-9)
    only(1, force, np.full(5000, 4.0))


GAPS = np.linspace(-6e-4, 6e-4, 25)


@pytest.mark.parametrize(
    ("effect", "curve"),
    [
        (SensorGain(2, -0.01), lambda g: 0.99 * g),
        (SensorNonlinearity(2, 0.02), lambda g: g / (1 + g / 0.02)),
        (SensorCrosstalk(2, 7, 0.03), lambda g: 1.03 * g),
    ],
)
def test_effect_changes_one_sensor_only(effect, curve) -> None:
    gap = seen(fresh(effect), GAPS)
    np.testing.assert_allclose(gap[:, 2], curve(GAPS), rtol=1e-12, atol=1e-18)
    only(2, gap, GAPS)


def test_crosstalk_is_of_the_other_sensor() -> None:
    gap = fresh(SensorCrosstalk(1, 7, 0.1)).gap(0.0, np.arange(9.0))
    np.testing.assert_allclose(gap, [0, 1.7, 2, 3, 4, 5, 6, 7, 8])


def test_drift_tends_to_its_offset() -> None:
    effect = fresh(SensorDrift(5, 2e-6, 100.0))
    for t, share in ((0.0, 0.0), (100.0, 1 - np.exp(-1)), (1e5, 1.0)):
        assert effect.gap(t, np.zeros(9))[5] == pytest.approx(2e-6 * share, abs=1e-18)


def test_sensor_lag_trails_a_ramp_by_its_time() -> None:
    tau, v = 5e-4, 1e-2
    ramp = v * np.arange(200) * DT
    gap = seen(fresh(SensorLag(6, tau)), ramp)
    t = np.arange(200) * DT
    np.testing.assert_allclose(gap[:, 6], ramp - v * tau * (1 - np.exp(-t / tau)), atol=1e-15)
    only(6, gap, ramp)


def test_stuck_sensor_freezes_and_recovers() -> None:
    ramp = np.arange(100) * 1e-6
    gap = seen(fresh(StuckSensor(3, begin_s=2e-3, stuck_s=3e-3, free_s=2e-3)), ramp)[:, 3]
    np.testing.assert_array_equal(gap[:20], ramp[:20])
    assert np.all(gap[21:49] == gap[21])  # 3 ms, up to rounding of the times at the edges
    np.testing.assert_array_equal(gap[51:69], ramp[51:69])
    assert np.all(gap[71:99] == gap[71])


def test_sticking_sensor_follows_within_its_step() -> None:
    gap_m = 5e-5 * np.sin(np.linspace(0, 6, 500))
    gap = seen(fresh(StickingSensor(8, 3e-6)), gap_m)[:, 8]
    assert np.abs(gap - gap_m).max() < 3e-6
    assert len(np.unique(gap)) < 100  # 200 um of way in steps of at least 3 um


def test_pickup_does_not_move_the_platform() -> None:
    gap = seen(fresh(MainsPickup(4, [1e-6])), np.zeros(10_000))
    assert np.abs(np.fft.rfft(gap[:, 4]))[50] * 2e-4 == pytest.approx(1e-6)
    only(4, gap, np.zeros(10_000))


# --- the flexible mode ---


@pytest.mark.parametrize("name", SHAPES)
def test_shapes_are_no_rigid_motion(name: str) -> None:
    """A force pattern of the shape has no wrench, and it shows in no pose."""
    mode = fresh(FlexibleMode(1.0, 0.5, 1.0, name))
    mode.coil_force(0.0, LEVEL, np.random.default_rng(4).standard_normal(9))
    shape = mode.gap(0.0, np.zeros(9))
    assert np.abs(shape).max() > 0
    grid = np.array([1, 0, -1]) * R
    x, y = np.repeat(grid, 3), np.tile(grid, 3)
    for rigid in (x, y, np.ones(9)):
        assert abs(shape @ rigid) < 1e-12 * np.abs(shape).max()


def test_mode_responds_as_an_oscillator() -> None:
    """The exact solution for forces held over each step, by scipy's linear simulation."""
    f, zeta, m = 90.0, 0.02, 4.0
    force_n = np.random.default_rng(6).standard_normal(600)
    drive = np.zeros(9)
    drive[0] = 1.0  # at a corner, where "twist" is 1
    mode, etas = fresh(FlexibleMode(f, zeta, m, "twist")), []
    for force in force_n:
        passed = mode.coil_force(0.0, LEVEL, force * drive)
        np.testing.assert_array_equal(passed, force * drive)
        etas.append(mode.gap(0.0, np.zeros(9))[0])
    w = 2 * np.pi * f
    system = lti([1 / m], [1, 2 * zeta * w, w * w])
    t = np.arange(601) * DT
    _, expected, _ = lsim(system, np.append(force_n, 0.0), t, interp=False)
    np.testing.assert_allclose(etas, expected[1:], rtol=1e-6, atol=1e-6 * np.abs(expected).max())


def test_mode_s_shape_may_be_measured() -> None:
    at_coils, at_sensors = np.arange(9) / 8, 1 - np.arange(9) / 8
    mode = fresh(FlexibleMode(50.0, 0.01, 2.0, at_coils.tolist(), at_sensors.tolist()))
    mode.coil_force(0.0, LEVEL, np.ones(9))
    moved = mode.gap(0.0, np.zeros(9))
    np.testing.assert_allclose(moved / moved[0], at_sensors, atol=1e-12)
