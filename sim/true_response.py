"""Compute the true frequency response of the simulated plant, as reference for identification."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..config.sim import SimConfig
from ..model.geometry import decoupling_matrix
from ..model.second_order import SecondOrder, StateSpace, discretise
from . import plant_kernels as k
from .plant_arrays import GRAVITY_M_S2, Arrays, air_damping, rods
from .plant_kernels import Array


def frequency_response(
    config: SimConfig, x_b_m: float, freq_hz: ArrayLike, rate_hz: float
) -> NDArray[np.complex128]:
    """Return P (F, 3, 3) at freq_hz (F,): pose [psi, theta, z] over commanded wrench.

    P is the plant sampled at `rate_hz`, linearised at pose 0 with the beam at rest at x_b: wrench,
    T^T, one cycle of delay, zero-order hold, current lag, plant, sensors, T, pose. Units are rad/(N
    m), rad/N, m/(N m) and m/N. Effects are not included.
    """
    return state_space(config, x_b_m, rate_hz).response(np.asarray(freq_hz, dtype=np.float64))


def state_space(config: SimConfig, x_b_m: float, rate_hz: float) -> StateSpace:
    """Return the discrete-time state space of the plant with the response `frequency_response`.

    The level `declared` is discretised exactly with a matrix exponential, independent of the
    simulation code. For the level `nonlinear`, one simulated control period is differentiated
    numerically, drive loops included, without noise and encoder quantisation.
    """
    if config.plant == "declared":
        return discretise(declared_model(config, x_b_m, rate_hz), 1.0 / rate_hz)
    return _linearised(config, x_b_m, 1.0 / rate_hz)


def declared_model(config: SimConfig, x_b_m: float, rate_hz: float) -> SecondOrder:
    """Return eqs. (2) to (6) for the beam at rest at x_b, with lag and one cycle of delay."""
    platform, m_b, z_b = config.platform, config.beam.m_b_kg, config.beam.z_b_m
    J_psi = platform.j_psi_kg_m2 + m_b * z_b**2
    J_theta = platform.j_theta_kg_m2 + m_b * (z_b**2 + x_b_m**2)
    J_c, m_x = platform.j_psitheta_kg_m2, m_b * x_b_m
    M = np.array([[J_psi, J_c, 0.0], [J_c, J_theta, m_x], [0.0, m_x, platform.m_p_kg + m_b]])
    K = rods(config) - z_b * m_b * GRAVITY_M_S2 * np.diag([1.0, 1.0, 0.0])
    weight = -GRAVITY_M_S2 * np.array([0.0, m_b * x_b_m, platform.m_p_kg + m_b])
    return SecondOrder(
        M, air_damping(config), K, np.eye(3), weight, config.coils.lag_s, 1.0 / rate_hz
    )


def _linearised(config: SimConfig, x_b_m: float, period_s: float) -> StateSpace:
    a = Arrays.build(config, period_s)
    a.par[[k.BEAM_LSB, k.ROTOR_LSB]] = 0.0  # quantisation has no derivative
    geometry = config.geometry
    T = decoupling_matrix(geometry.sensor_x, geometry.sensor_y)
    T_coils = decoupling_matrix(geometry.coil_x_m, geometry.coil_y_m)
    n_coils = geometry.n_coils
    beam_ref = np.array([x_b_m, 0.0, 0.0])
    no_ref = np.zeros(3)

    start = np.zeros(k.STATE_SIZE)
    start[[k.Q + 3, k.BEAM_TO, k.BEAM_LOOP + k.LOOP_LAST]] = x_b_m
    hover = _hovering_forces(a, start, T_coils)
    # States: positions, velocities, currents, both drives' integrator, filtered speed, encoder.
    loops = [loop + j for loop in (k.BEAM_LOOP, k.ROTOR_LOOP) for j in (1, 2, 3)]
    states = np.array([*range(k.Q, k.Q + 10), *loops])
    n = len(states) + n_coils
    # Steps are small compared with the scale of nonlinearities (0.1 mm) and large compared with
    # rounding errors.
    positions, rates = [1e-5, 1e-5, 1e-6, 1e-7, 1e-5], [1e-4, 1e-4, 1e-5, 1e-6, 1e-4]
    drives = [1e-3, 1e-6, 1e-7, 1e-5, 1e-4, 1e-5]
    size = np.array(positions + rates + drives + [1e-3] * n_coils)

    def period(change: Array, wrench: Array) -> tuple[Array, Array]:
        a.st[:], a.coils[k.CURRENT] = start, hover + change[len(states) :]
        a.st[states] += change[: len(states)]
        command = hover + T_coils.T @ wrench
        k.gaps_nonlinear(a.st, a.sensors)
        gaps = a.sensors[k.SENSOR_GAIN] * a.sensors[k.GAP]
        k.advance_nonlinear(
            a.par, a.st, a.coils, a.sensors, a.noise, a.out, command, beam_ref, no_ref
        )
        return np.concatenate([a.st[states], a.coils[k.CURRENT]]), T @ gaps

    def slope(step: Array, wrench: Array, by: float) -> tuple[Array, Array]:
        (up, y_up), (down, y_down) = period(step, wrench), period(-step, -wrench)
        return (up - down) / (2.0 * by), (y_up - y_down) / (2.0 * by)

    A, B, C = np.zeros((n + 3, n + 3)), np.zeros((n + 3, 3)), np.zeros((3, n + 3))
    for j in range(n):
        A[:n, j], C[:, j] = slope(size[j] * np.eye(n)[j], np.zeros(3), size[j])
    for j in range(3):  # three more states delay the wrench by one cycle
        A[:n, n + j], _ = slope(np.zeros(n), 1e-3 * np.eye(3)[j], 1e-3)
    B[n:] = np.eye(3)
    return StateSpace(A, B, C, np.zeros((3, 3)), period_s)


def _hovering_forces(a: Arrays, start: Array, T_coils: Array) -> Array:
    """Return the coil forces T^T tau (C,) that hold the platform at rest at `start`, N."""

    def acceleration(tau: Array) -> Array:
        a.st[:], a.coils[k.CURRENT] = start, T_coils.T @ tau
        k.accelerations_nonlinear(a.par, a.st, a.coils)
        return a.st[k.A : k.A + 3].copy()

    without = acceleration(np.zeros(3))
    per_wrench = np.stack([acceleration(unit) - without for unit in np.eye(3)], axis=1)
    return np.asarray(T_coils.T @ np.linalg.solve(per_wrench, -without))
