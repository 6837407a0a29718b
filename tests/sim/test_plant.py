"""Test the simulated plant: discretisation, stops, electronics, noise, hovering."""

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from repository_folders import SIMS
from scipy.linalg import expm

from levid.config.base import load_yaml
from levid.config.sim import SimConfig
from levid.model.geometry import decoupling_matrix
from levid.sim import plant_kernels as k
from levid.sim.plant import LEVELS, Plant
from levid.sim.plant_arrays import Arrays, lag_weights, resting_pose

NONE = np.zeros(3)
Array = NDArray[np.float64]


def load(name: str, **changes: dict[str, Any]) -> SimConfig:
    """A shipped SIM.yaml with values of some sections changed."""
    config = load_yaml(SIMS / f"{name}.yaml", SimConfig).model_dump()
    for section, values in changes.items():
        config[section] |= values
    return SimConfig.model_validate(config)


def coils_t(config: SimConfig) -> Array:
    """T^T (C, 3): coil forces of a wrench."""
    return decoupling_matrix(config.geometry.coil_x_m, config.geometry.coil_y_m).T


@pytest.mark.parametrize("period_s", [1e-3, 1e-4])
@pytest.mark.parametrize("x_b", [-0.1, 0.0])
def test_declared_plant_is_the_exact_discretisation(period_s: float, x_b: float) -> None:
    """The sampled plant with current lag and hold equals one matrix exponential per period."""
    config = load("nominal", coils={"noise_n": 0.0})
    a = Arrays.build(config, period_s)
    m_b, z_b, p, lag = config.beam.m_b_kg, config.beam.z_b_m, config.platform, config.coils.lag_s
    r, d, g = config.geometry.r_m, config.air.d_n_s_m, 9.81
    J_c = p.j_psitheta_kg_m2
    M = np.array(
        [
            [p.j_psi_kg_m2 + m_b * z_b**2, J_c, 0],
            [J_c, p.j_theta_kg_m2 + m_b * (z_b**2 + x_b**2), m_b * x_b],
            [0, m_b * x_b, p.m_p_kg + m_b],
        ]
    )
    K = np.array([[210.0, 3, 8], [3, 190, -6], [8, -6, 2600]]) - np.diag([z_b * m_b * g] * 2 + [0])
    D = np.diag([6 * r**2 * d, 6 * r**2 * d, 9 * d])
    zero, one = np.zeros((3, 3)), np.eye(3)
    block = np.zeros((12, 12))
    block[:9, :9] = np.block(
        [
            [zero, one, zero],
            np.split(np.linalg.solve(M, np.hstack([-K, -D, one])), 3, axis=1),
            [zero, zero, -one / lag],
        ]
    )
    block[6:9, 9:] = one / lag
    step = expm(block * period_s)

    hover = coils_t(config) @ np.array([0.0, m_b * g * x_b, g * (p.m_p_kg + m_b)])
    a.st[:] = 0.0
    a.st[k.Q + 3] = a.st[k.BEAM_TO] = x_b
    a.coils[k.CURRENT] = hover
    rng, state, error, size = np.random.default_rng(3), np.zeros(9), 0.0, 0.0
    for _ in range(300):
        wrench = rng.standard_normal(3) * [0.1, 0.1, 1.3]
        k.advance_declared(
            a.par, a.st, a.coils, a.sensors, a.noise, a.out,
            hover + coils_t(config) @ wrench, np.array([x_b, 0.0, 0.0]), NONE,
        )  # fmt: skip
        state = step[:9] @ np.concatenate([state, wrench])
        error = max(error, np.abs(a.st[k.Q : k.Q + 3] - state[:3]).max())
        size = max(size, np.abs(state[:3]).max())
    # Runge-Kutta: (w h)^5 / 120 a step, w = 60 rad/s, over 3000 steps is 2e-10.
    assert error < 1e-9 * size


def test_lag_weights_have_the_moments_of_the_exponential() -> None:
    """Runge-Kutta's sums of the three values are the exponential's integrals."""
    for ratio in (1e-6, 0.1, 1 / 3, 0.999, 1.001, 30.0):
        first, half, last, mean = lag_weights(ratio)
        s = np.linspace(0.0, 1.0, 20001)
        for found, weight in (
            ((first + 4 * half + last) / 6, np.ones_like(s)),
            ((first + 2 * half) / 6, 1 - s),
            ((first + half) / 6, (1 - s) ** 2),
        ):
            values = weight * np.exp(-ratio * s)
            simpson = values[0] + values[-1] + 4 * values[1::2].sum() + 2 * values[2:-1:2].sum()
            assert found == pytest.approx(simpson / 60000, abs=1e-12)
        assert mean == pytest.approx((first + 4 * half + last) / 6, abs=1e-15)
    # Where the step is short against the lag, they are the exponential's own values.
    np.testing.assert_allclose(lag_weights(1e-3)[:3], np.exp([0, -5e-4, -1e-3]), atol=1e-10)


@pytest.mark.parametrize("name", ["nominal", "rig"])
def test_platform_falls_and_rests_on_the_lower_stops(name: str) -> None:
    config = load(name, coils={"noise_n": 0.0})
    a = Arrays.build(config, 1e-3)
    a.st[k.Q : k.Q + 3] = 0.0
    lowest = 0.0
    for _ in range(500):
        LEVELS[config.plant].advance(
            a.par, a.st, a.coils, a.sensors, a.noise, a.out, np.zeros(9), NONE, NONE
        )
        lowest = min(lowest, a.st[k.Q + 2])
    assert lowest < -0.905e-3  # impact
    # The rest position follows from statics; the rig's centre of mass shifts it by about 0.05 um.
    np.testing.assert_allclose(a.st[k.Q : k.Q + 3], resting_pose(config), atol=2e-6)
    assert np.abs(a.st[k.V : k.V + 3]).max() < 1e-7
    assert -0.91e-3 < a.st[k.Q + 2] < -0.90e-3  # sags less than 10 um under 69 N


def test_end_stops_have_no_tensile_force() -> None:
    a = Arrays.build(load("nominal"), 1e-3)
    for h in np.linspace(-1.2e-3, 1.2e-3, 49):
        for speed in (-1.0, 0.0, 1.0):
            force = k.stop_force(a.par, h, speed)
            assert force * h <= 0.0
            assert force == 0.0 or abs(h) > 0.9e-3


def test_coils_saturate_and_lag() -> None:
    """A step of 30 N reads 20 (1 - e^(-1/0.3)) N after 1 ms and 20 N for good."""
    config = load("nominal", coils={"noise_n": 0.0})
    plant = Plant(config, 1e-3)
    seen = []
    for _ in range(30):
        plant.advance(np.array([30.0, -30.0] + [5.0] * 7), NONE, NONE)
        plant.sample()
        seen.append(plant.coil_readback_n.copy())
    first = 1.0 - np.exp(-1e-3 / config.coils.lag_s)
    np.testing.assert_allclose(seen[0], first * np.array([20, -20] + [5] * 7), rtol=1e-12)
    np.testing.assert_allclose(seen[-1], [20, -20] + [5] * 7, rtol=1e-12)


@pytest.mark.parametrize("period_s", [1e-3, 1e-4])
def test_sensor_noise_is_white_and_quantised(period_s: float) -> None:
    config = load("nominal", coils={"noise_n": 0.0})
    plant = Plant(config, period_s)
    gaps = []
    for _ in range(4000):
        plant.advance(np.zeros(9), NONE, NONE)
        plant.sample()
        gaps.append(plant.gap_m.copy())
    lsb = 2e-3 / 2**16
    codes = np.array(gaps) / lsb
    np.testing.assert_allclose(codes, np.rint(codes), atol=1e-6)
    noise = np.array(gaps[2000:]) - np.mean(gaps[2000:], axis=0)
    # 0.1 um and the converter's step / sqrt 12; 18000 samples give the variance to 1 percent.
    assert noise.var() == pytest.approx(1e-14 + lsb**2 / 12, rel=0.05)
    near = np.mean(noise[1:] * noise[:-1]) / noise.var()
    assert abs(near) < 5 / np.sqrt(noise.size)
    across = np.corrcoef(noise.T) - np.eye(9)
    assert np.abs(across).max() < 5 / np.sqrt(len(noise))


def test_sensors_clip_at_their_range() -> None:
    a = Arrays.build(load("nominal"), 1e-3)
    a.sensors[k.GAP] = np.linspace(-2e-3, 2e-3, 9)
    k.measure_declared(a.par, a.st, a.coils, a.sensors, a.noise, a.out)
    assert a.out[0] == -1e-3
    assert a.out[8] == pytest.approx(1e-3 - 2e-3 / 2**16, rel=1e-12)  # two's complement


@pytest.mark.parametrize("step_s", [1e-4, 5e-5])
def test_amplifier_noise_keeps_its_density_at_any_step(step_s: float) -> None:
    """1 mN rms held 0.1 ms: the variance of one held value times the hold is 1e-10 N^2 s."""
    config = load("nominal").model_copy(update={"step_s": step_s})
    plant = Plant(config, step_s)
    seen = []
    for _ in range(4000):
        plant.advance(np.zeros(9), NONE, NONE)
        plant.sample()
        seen.append(plant.coil_readback_n.copy())
    # 36000 values give the variance to 0.8 percent.
    assert np.var(seen) * step_s == pytest.approx(1e-10, rel=0.04)


@pytest.mark.parametrize("name", ["nominal", "rig"])
def test_same_seed_gives_same_readings_and_a_second_sample_is_equal(name: str) -> None:
    config = load(name)
    other = config.model_copy(update={"seed": config.seed + 1})
    plants = [Plant(config, 1e-3), Plant(config, 1e-3), Plant(other, 1e-3)]
    command = np.full(9, 7.0)
    for i in range(50):
        for plant in plants:
            plant.advance(command, NONE, NONE)
        plants[0].sample()
        plants[0].sample()  # a second call changes nothing
        if i % 7 == 0:
            plants[1].sample()
    for plant in plants:
        plant.sample()
    assert plants[0].gap_m.tobytes() == plants[1].gap_m.tobytes()
    assert plants[0].beam.tobytes() == plants[1].beam.tobytes()
    assert plants[0].coil_readback_n.tobytes() == plants[1].coil_readback_n.tobytes()
    assert plants[0].gap_m.tobytes() != plants[2].gap_m.tobytes()
    assert plants[0].time_s == pytest.approx(0.05, rel=1e-12)


def hover(config: SimConfig, period_s: float, seconds: float, x_b: float = 0.0) -> Array:
    """Poses (N, 3) with the starting gains, from the stops, with one cycle of delay."""
    T = decoupling_matrix(config.geometry.sensor_x, config.geometry.sensor_y)
    kp, ki = np.array([20.0, 20.0, 500.0]), np.array([200.0, 200.0, 3000.0]) * period_s
    m_b, total = config.beam.m_b_kg, config.beam.m_b_kg + config.platform.m_p_kg
    weight = 9.81 * np.array([0.0, m_b * x_b, total])
    plant = Plant(config, period_s)
    integral, pending, poses = np.zeros(3), np.zeros(9), []
    ref = np.array([x_b, 0.0, 0.0])
    for _ in range(round(seconds / period_s)):
        pose = T @ plant.gap_m
        poses.append(pose)
        integral -= ki * pose
        plant.advance(pending, ref, NONE)
        pending = coils_t(config) @ (weight - kp * pose + integral)
        plant.sample()
    return np.array(poses)


@pytest.mark.parametrize("name", ["nominal", "rig"])
@pytest.mark.parametrize("period_s", [1e-3, 1e-4])
def test_starting_gains_hover(name: str, period_s: float) -> None:
    config = load(name, beam={"start_m": 0.1})
    poses = hover(config, period_s, 6.0, x_b=0.1)
    late = poses[-round(1.0 / period_s) :]
    # Amplifier noise moves the height by some 0.1 um; the integrators' slow tail is below 5 um.
    assert np.abs(late[:, 2]).max() < 5e-6
    assert np.abs(late[:, :2]).max() < 5e-5


def test_beam_and_rotor_are_at_their_setpoints_when_the_period_ends() -> None:
    """Beam and rotor reach a setpoint at the end of its period."""
    config = load("nominal")
    plant = Plant(config, 1e-3)
    for i in range(1, 101):
        t = i * 1e-3
        ref = np.array([0.02 * (1 - np.cos(30 * t)), 0.6 * np.sin(30 * t), 18 * np.cos(30 * t)])
        plant.advance(np.full(9, 69.0 / 9), ref, 2.0 * ref)
        plant.sample()
        assert plant.beam[0] == pytest.approx(ref[0], abs=1e-8)  # the encoder's step
        assert plant.beam[1] == pytest.approx(ref[1], abs=1e-9)
        assert plant.rotor[2] == pytest.approx(2.0 * config.rotor.j_kg_m2 * ref[2], rel=1e-9)
    assert plant.beam_state.a_m_s2 == pytest.approx(ref[2], rel=1e-9)


@pytest.mark.parametrize("period_s", [1e-3, 1e-4])
def test_nonlinear_drives_track(period_s: float) -> None:
    """Against friction, at 120 Hz, the beam stays within 20 um of a sweep at 1 m/s and 2 g."""
    config = load("rig")
    plant = Plant(config, period_s)
    worst, force = 0.0, 0.0
    for i in range(1, round(0.5 / period_s)):
        w = 20.0
        t = i * period_s
        ref = 0.05 * np.array([1 - np.cos(w * t), w * np.sin(w * t), w * w * np.cos(w * t)])
        plant.advance(np.zeros(9), ref, 10 * ref)
        plant.sample()
        if t > 0.1:
            worst = max(worst, abs(plant.beam[0] - ref[0]), abs(plant.rotor[0] - 10 * ref[0]) / 10)
            force = max(force, abs(plant.beam[2] - config.beam.m_b_kg * ref[2]))
    assert worst < 20e-6
    assert force < 3.0  # friction 1.3 N and the loop's share of it


def test_command_of_wrong_size_or_not_finite_is_rejected() -> None:
    plant = Plant(load("nominal"), 1e-3)
    with pytest.raises(ValueError, match="expected coil_n"):
        plant.advance(np.zeros(8), NONE, NONE)
    with pytest.raises(ValueError, match="finite"):
        plant.advance(np.full(9, np.nan), NONE, NONE)
    with pytest.raises(ValueError, match="period_s"):
        Plant(load("nominal"), 0.0)


def test_period_is_divided_into_equal_internal_steps() -> None:
    for period_s, steps in ((1e-3, 10), (1e-4, 1), (1.5e-4, 2), (5e-5, 1), (1 / 3000, 4)):
        plant = Plant(load("nominal"), period_s)
        assert plant.dt_s == pytest.approx(period_s / steps, rel=1e-12)


def test_plant_of_four_coils_and_three_sensors() -> None:
    """The code does not assume nine coils and sensors."""
    r = 0.1
    geometry = {
        "coil_x_m": (r, r, -r, -r),
        "coil_y_m": (r, -r, r, -r),
        "sensor_x_m": (r, -r, 0.0),
        "sensor_y_m": (r, r, -r),
    }
    config = load("nominal", geometry=geometry)
    plant = Plant(config, 1e-3)
    plant.advance(np.full(4, 5.0), NONE, NONE)
    plant.sample()
    assert plant.gap_m.shape == (3,)
    assert plant.coil_readback_n.shape == (4,)
