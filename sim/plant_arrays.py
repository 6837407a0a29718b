"""Build the flat arrays of the plant's constants and state for the compiled kernels."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..config.sim import DriveLoop, SimConfig
from ..model.geometry import shape_matrix
from . import plant_kernels as k
from .plant_kernels import Array

GRAVITY_M_S2 = 9.81


@dataclass(frozen=True)
class Arrays:
    """Constants `par`, state `st`, `coils` (rows, C), `sensors` (rows, S).

    plant_kernels defines the indices. `noise` (N C + S,) has the standard normal numbers of one
    period: N steps of C coils, then S sensors. `out` (S + C + 6,) has the readings: gaps, readback,
    beam (3), rotor (3).
    """

    par: Array
    st: Array
    coils: Array
    sensors: Array
    noise: Array
    out: Array
    n_steps: int

    @classmethod
    def build(cls, config: SimConfig, period_s: float) -> Arrays:
        """Return the arrays for the platform at rest on its lower stops, the beam at its start.

        Raises:
            ValueError: the period is not a positive number.
        """
        if not (math.isfinite(period_s) and period_s > 0):
            raise ValueError(f"period_s: expected a positive number of seconds, found {period_s}")
        # The margin avoids eleven steps for 1e-3 / 1e-4 due to rounding.
        n_steps = max(1, math.ceil(period_s / config.step_s - 1e-9))
        geometry = config.geometry
        coils = np.zeros((k.COIL_ROWS, geometry.n_coils))
        coils[k.COIL_X], coils[k.COIL_Y] = geometry.coil_x_m, geometry.coil_y_m
        coils[k.COIL_GAIN] = 1.0
        sensors = np.zeros((k.SENSOR_ROWS, geometry.n_sensors))
        sensors[k.SENSOR_X], sensors[k.SENSOR_Y] = geometry.sensor_x, geometry.sensor_y
        sensors[k.SENSOR_GAIN] = 1.0
        more = config.nonlinear
        if more is not None:
            coils[k.COIL_GAIN] = more.coil_gain or 1.0
            sensors[k.SENSOR_GAIN] = more.sensor_gain or 1.0
            sensors[k.SENSOR_OFFSET] = more.sensor_offset_m or 0.0
        par = _constants(config, period_s, n_steps)
        st = np.zeros(k.STATE_SIZE)
        st[k.Q + 3] = st[k.BEAM_TO] = st[k.BEAM_LOOP + k.LOOP_LAST] = config.beam.start_m
        st[k.Q : k.Q + 3] = resting_pose(config)
        n_coils, n_sensors = geometry.n_coils, geometry.n_sensors
        noise = np.zeros(n_steps * n_coils + n_sensors)
        return cls(par, st, coils, sensors, noise, np.zeros(n_sensors + n_coils + 6), n_steps)


def resting_pose(config: SimConfig) -> Array:
    """Return the pose (3,) in rad, rad, m at rest on the lower stops without coil force."""
    x, y = stops_at(config)
    S = shape_matrix(x, y)
    stiffness = config.end_stops.k_n_m
    stops = stiffness * S.T @ S
    beam = config.beam.m_b_kg * GRAVITY_M_S2
    tilt = -config.beam.z_b_m * beam * np.diag([1.0, 1.0, 0.0])
    weight = [0.0, -beam * config.beam.start_m, -config.platform.m_p_kg * GRAVITY_M_S2 - beam]
    push = -stiffness * config.end_stops.travel_m * S.sum(axis=0)
    return np.linalg.solve(rods(config) + tilt + stops, np.asarray(weight) + push)


def rods(config: SimConfig) -> Array:
    """Return the rods' stiffness (3, 3) in N m/rad, N/rad, N/m, without gravity."""
    r = config.rods
    return np.array(
        [
            [r.k_psi_n_m_rad, r.k_psi_theta_n_m_rad, r.k_psi_z_n_rad],
            [r.k_psi_theta_n_m_rad, r.k_theta_n_m_rad, r.k_theta_z_n_rad],
            [r.k_psi_z_n_rad, r.k_theta_z_n_rad, r.k_z_n_m],
        ]
    )


def air_damping(config: SimConfig) -> Array:
    """Return the coils' air damping D (3, 3) in N m s/rad, N s/rad, N s/m: eq. (5) for any grid."""
    S = shape_matrix(config.geometry.coil_x_m, config.geometry.coil_y_m)
    return np.asarray(config.air.d_n_s_m * S.T @ S)


def stops_at(config: SimConfig) -> tuple[Sequence[float], Sequence[float]]:
    """Return x and y of the end stops in m; default: the corners of the coils' rectangle."""
    stops = config.end_stops
    if stops.x_m is not None and stops.y_m is not None:
        return stops.x_m, stops.y_m
    x, y = config.geometry.coil_x_m, config.geometry.coil_y_m
    return (max(x), max(x), min(x), min(x)), (max(y), min(y), max(y), min(y))


def lag_weights(ratio: float) -> tuple[float, float, float, float]:
    """Return (c0, c_half, c1, mean) for e^(-ratio s) over a step, s from 0 to 1.

    The c replace the values of the exponential at s = 0, 1/2, 1, so that the Runge-Kutta weights
    give its integrals m1, m2, m3 with 1, (1 - s), (1 - s)^2 exactly:
    (c0 + 4 c_half + c1) / 6 = m1, (c0 + 2 c_half) / 6 = m2, (c0 + c_half) / 6 = m3.
    """
    if math.isinf(ratio):  # without lag the force equals the command
        return 0.0, 0.0, 0.0, 0.0
    # m_j = integral of (1 - s)^(j-1) e^(-ratio s), as a series: a recursion would lose digits.
    if ratio < 1.0:
        m1, m2, m3 = (
            sum((-ratio) ** i * math.factorial(j) / math.factorial(i + j + 1) for i in range(20))
            for j in range(3)
        )
    else:
        m1 = -math.expm1(-ratio) / ratio
        m2 = (1.0 - m1) / ratio
        m3 = (1.0 - 2.0 * m2) / ratio
    half, first = 6.0 * (m2 - m3), 12.0 * m3 - 6.0 * m2
    return first, half, 6.0 * m1 - first - 4.0 * half, m1


def _constants(config: SimConfig, period_s: float, n_steps: int) -> Array:
    x, y = stops_at(config)
    par = np.zeros(k.STOPS + 2 * len(x))
    step = period_s / n_steps
    coils, sensors, platform = config.coils, config.sensors, config.platform
    ratio = step / coils.lag_s if coils.lag_s > 0 else math.inf
    par[[k.STEP, k.PERIOD, k.G]] = step, period_s, GRAVITY_M_S2
    par[[k.M_P, k.M_B, k.Z_B]] = platform.m_p_kg, config.beam.m_b_kg, config.beam.z_b_m
    par[[k.J_PSI, k.J_THETA]] = platform.j_psi_kg_m2, platform.j_theta_kg_m2
    par[k.J_PSITHETA] = platform.j_psitheta_kg_m2
    par[k.LIMIT], par[k.DECAY] = coils.limit_n, math.exp(-ratio)
    par[[k.LAG_0, k.LAG_HALF, k.LAG_1, k.LAG_MEAN]] = lag_weights(ratio)
    # Scale the noise to the step so that its low-frequency density rms^2 hold is unchanged.
    par[k.AMPLIFIER_NOISE] = coils.noise_n * math.sqrt(coils.noise_hold_s / step)
    par[k.SENSOR_NOISE] = sensors.noise_m
    par[k.LSB] = 2.0 * sensors.range_m / 2**sensors.bits
    par[k.CODE_MAX] = 2 ** (sensors.bits - 1) - 1
    par[k.BEAM_LSB] = config.drives.beam_encoder_m
    par[k.ROTOR_LSB] = config.drives.rotor_encoder_rad
    par[k.J_ROTOR], par[k.AIR_D] = config.rotor.j_kg_m2, config.air.d_n_s_m
    stops = config.end_stops
    par[[k.STOP_TRAVEL, k.STOP_K, k.STOP_D]] = stops.travel_m, stops.k_n_m, stops.d_n_s_m
    par[k.K : k.K + 9] = rods(config).ravel()
    par[k.D : k.D + 9] = air_damping(config).ravel()
    more = config.nonlinear
    if more is not None:
        par[k.COM : k.COM + 3] = more.com_m
        par[k.J_Z], par[k.SLOPE] = more.j_z_kg_m2, more.coil_slope_1_m
        par[k.IMBALANCE], par[k.ROTOR_Z] = more.rotor_imbalance_kg_m, more.rotor_z_m
        par[k.CUBIC] = more.rods_cubic_psi_n_m_rad3
        par[k.CUBIC + 1] = more.rods_cubic_theta_n_m_rad3
        par[k.CUBIC + 2] = more.rods_cubic_z_n_m3
        _drive(par, k.BEAM_DRIVE, more.beam_drive, config.beam.m_b_kg, step)
        _drive(par, k.ROTOR_DRIVE, more.rotor_drive, config.rotor.j_kg_m2, step)
    par[k.STOPS :: 2], par[k.STOPS + 1 :: 2] = x, y
    return par


def _drive(par: Array, at: int, loop: DriveLoop, mass: float, step_s: float) -> None:
    """Set a drive's gains: configured bandwidth, damping 0.9, integrator 5 times slower."""
    w = 2.0 * math.pi * loop.bandwidth_hz
    par[at + k.DRIVE_KP] = mass * w**2
    par[at + k.DRIVE_KI] = mass * w**3 / 5.0
    par[at + k.DRIVE_KD] = 1.8 * mass * w
    par[at + k.DRIVE_MASS], par[at + k.DRIVE_LIMIT] = mass, loop.limit
    par[at + k.DRIVE_FILTER] = math.exp(-10.0 * w * step_s)  # speed filter at 10 times bandwidth
    par[at + k.COULOMB], par[at + k.COULOMB_SPEED] = loop.coulomb, loop.coulomb_speed
    par[at + k.VISCOUS] = loop.viscous
