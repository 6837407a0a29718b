"""Test the true response against the simulation, and the two plant levels against each other."""

import numpy as np
import pytest
from repository_folders import SIMS

from levid.config.base import load_yaml
from levid.config.sim import SimConfig
from levid.model.geometry import decoupling_matrix
from levid.sim import plant_kernels as k
from levid.sim.plant import LEVELS
from levid.sim.plant_arrays import Arrays
from levid.sim.true_response import frequency_response, state_space


def load(name: str) -> SimConfig:
    return load_yaml(SIMS / f"{name}.yaml", SimConfig)


@pytest.mark.parametrize("rate_hz", [1e3, 1e4])
@pytest.mark.parametrize(("name", "tolerance"), [("nominal", 1e-9), ("rig", 2e-3)])
def test_truth_predicts_the_simulation(name: str, tolerance: float, rate_hz: float) -> None:
    """Random wrenches around hovering at x_b = 0.1: the linear system predicts the poses.

    The rig's cubic rods (1 percent of the rods' force at 0.6 mm, by its square at 0.1 mm) and its
    drive's friction change a response of some 10 um by less than 2e-3.
    """
    config = load(name)
    a = Arrays.build(config, 1.0 / rate_hz)
    a.par[[k.AMPLIFIER_NOISE, k.BEAM_LSB, k.ROTOR_LSB]] = 0.0
    advance = LEVELS[config.plant].advance
    gaps = LEVELS[config.plant].gaps
    T = decoupling_matrix(config.geometry.coil_x_m, config.geometry.coil_y_m)
    x_b = 0.1
    ref, none = np.array([x_b, 0.0, 0.0]), np.zeros(3)

    def reset(hover: np.ndarray) -> None:
        a.st[:] = 0.0
        a.st[[k.Q + 3, k.BEAM_TO, k.BEAM_LOOP + k.LOOP_LAST]] = x_b
        a.coils[k.CURRENT] = hover

    # Hovering forces by Newton's method on the simulation, independent of the true response's code.
    tau = np.array([0.0, 1.4 * 9.81 * x_b, 7.0 * 9.81])
    accelerations = LEVELS[config.plant].accelerations
    for _ in range(4):
        reset(T.T @ tau)
        accelerations(a.par, a.st, a.coils)
        M = np.diag([0.067, 0.077, 7.0])
        M[1, 2] = M[2, 1] = 1.4 * x_b
        tau = tau - M @ a.st[k.A : k.A + 3]
    hover = T.T @ tau
    reset(hover)

    system = state_space(config, x_b, rate_hz)
    state, waiting = np.zeros(len(system.A)), np.zeros(3)
    rng, found, said = np.random.default_rng(5), [], []
    for _ in range(round(0.2 * rate_hz)):
        gaps(a.st, a.sensors)
        found.append(T @ (a.sensors[k.SENSOR_GAIN] * a.sensors[k.GAP]))
        said.append(system.C @ state)
        wrench = 0.1 * rng.standard_normal(3) * [0.1, 0.1, 1.3]
        advance(a.par, a.st, a.coils, a.sensors, a.noise, a.out, hover + T.T @ waiting, ref, none)
        state, waiting = system.A @ state + system.B @ wrench, wrench
    scale = np.abs(said).max(axis=0)
    assert (np.abs(np.array(found) - said).max(axis=0) < tolerance * scale).all()


def test_response_has_the_delay_the_hold_and_the_lag() -> None:
    """Far above the modes the phase is that of 1/s^2, one cycle, half a hold and the lag."""
    freq, rate = np.array([100.0]), 1e4
    P = frequency_response(load("nominal"), 0.0, freq, rate)[0, 2, 2]
    w = 2 * np.pi * freq[0]
    expected = -np.pi - w * 1.5 / rate - np.arctan(w * 3e-4)
    # The damping of 36 N s/m adds 36 / (7 w) = 0.008 rad.
    assert np.angle(P * np.exp(-1j * expected)) == pytest.approx(0.0, abs=0.01)
    # Stiffness 2600 N/m against 7 w^2: 0.1 percent.
    assert abs(P) == pytest.approx(1 / (7 * w**2 * np.hypot(1, w * 3e-4)), rel=2e-3)


def test_static_gain_is_the_inverse_stiffness() -> None:
    config = load("nominal")
    P = frequency_response(config, 0.0, [1e-3], 1e3)[0]
    tilt = 0.06 * 1.4 * 9.81
    K = np.array([[210.0 - tilt, 3, 8], [3, 190 - tilt, -6], [8, -6, 2600]])
    # At 1 mHz damping and delay leave a phase of 1e-4 rad.
    np.testing.assert_allclose(P, np.linalg.inv(K), rtol=2e-3)


@pytest.mark.parametrize("x_b", [-0.1, 0.0, 0.1])
def test_the_rigs_imperfections_are_small(x_b: float) -> None:
    """Away from its resonances (3, 9 Hz) the rig is within 0.6 dB and 5 degrees of the model."""
    freq = np.array([1.0, 20.0, 40.0, 64.0])
    declared = frequency_response(load("nominal"), x_b, freq, 1e3)
    rig = frequency_response(load("rig"), x_b, freq, 1e3)
    for j in range(3):
        ratio = rig[:, j, j] / declared[:, j, j]
        assert np.abs(20 * np.log10(np.abs(ratio))).max() < 0.6
        assert np.abs(np.angle(ratio, deg=True)).max() < 5.0


@pytest.mark.parametrize("name", ["nominal", "rig"])
@pytest.mark.parametrize("rate_hz", [1e3, 1e4])
def test_truth_is_stable_and_damped(name: str, rate_hz: float) -> None:
    poles = np.linalg.eigvals(state_space(load(name), 0.1, rate_hz).A)
    assert np.abs(poles).max() < 1.0
