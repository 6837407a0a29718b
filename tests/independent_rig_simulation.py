"""A second, independent implementation of the rig: the truth that identification is compared with.

Tests use it through the fixture `rig`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm

from levid.identification.records.record import PiController, Record

Array = NDArray[np.float64]

NAMES, UNITS_IN, UNITS_OUT = ("psi", "theta", "z"), ("N m", "N m", "N"), ("rad", "rad", "m")
R_M = 0.12
KP = np.array([20.0, 20.0, 500.0])
KI = np.array([200.0, 200.0, 3000.0])
LAG_S = 0.3e-3
EXCITATION_RMS = np.array([0.1, 0.1, 1.3])
SENSOR_NOISE_M = 0.1e-6
SENSOR_STEP_M = 2e-3 / 65536  # 16 bit over +-1 mm
COIL_NOISE_N = 1e-3
COIL_NOISE_HELD_S = 1e-4
COILS = np.array([(y, x, 1.0) for x in (1, 0, -1) for y in (1, 0, -1)]) * [R_M, R_M, 1.0]
T = np.linalg.pinv(COILS)  # (3, 9), eq. (9) corrected


@dataclass(frozen=True)
class SampledPlant:
    """x+ = A x + B w with w the wrench held over the period (no delay yet), y = C x."""

    A: Array
    B: Array
    C: Array
    Ts_s: float

    def frequency_response(self, freq_hz: Array) -> NDArray[np.complex128]:
        """Return P (F, 3, 3) from commanded wrench to pose, with one cycle of delay."""
        z = np.exp(2j * np.pi * freq_hz * self.Ts_s)[:, None, None]
        return self.C @ np.linalg.solve(z * np.eye(len(self.A)) - self.A, self.B) / z


def matrices(x_b_m: float) -> tuple[Array, Array, Array]:
    """Return M, D, K of eq. (2) to (5) with the design's nominal numbers."""
    m_p, m_b, z_b, g, d = 5.6, 1.4, 0.06, 9.81, 4.0
    M = np.array(
        [
            [0.062 + m_b * z_b**2, 0.0015, 0.0],
            [0.0015, 0.058 + m_b * (z_b**2 + x_b_m**2), m_b * x_b_m],
            [0.0, m_b * x_b_m, m_p + m_b],
        ]
    )
    D = np.diag([6 * R_M**2 * d, 6 * R_M**2 * d, 9 * d])
    K = np.array([[210.0, 3.0, 8.0], [3.0, 190.0, -6.0], [8.0, -6.0, 2600.0]])
    return M, D, K - np.diag([z_b * m_b * g, z_b * m_b * g, 0.0])


def sampled_plant(x_b_m: float, Ts_s: float, lag_s: float = LAG_S) -> SampledPlant:
    """Return the plant with its current loops, sampled exactly under a zero-order hold."""
    M, D, K = matrices(x_b_m)
    Mi = np.linalg.inv(M)
    Z, one = np.zeros((3, 3)), np.eye(3)
    Ac = np.block([[Z, one, Z], [-Mi @ K, -Mi @ D, Mi], [Z, Z, -one / lag_s]])
    Bc = np.vstack([Z, Z, one / lag_s])
    both = expm(np.block([[Ac, Bc], [np.zeros((3, 12))]]) * Ts_s)
    A, B = both[:9, :9].copy(), both[:9, 9:].copy()  # contiguous, for the loop
    return SampledPlant(A, B, np.hstack([one, Z, Z]), Ts_s)


def closed_loop_markov(plant: SampledPlant, length: int) -> Array:
    """Return the exact Markov parameters (length, 3, 3) of the loop G from v to y."""
    g = np.zeros((length, 3, 3))
    for j in range(3):
        v = np.zeros((length, 3))
        v[0, j] = 1.0
        g[:, :, j], _ = simulate(plant, v, noise=False)
    return g


def simulate(
    plant: SampledPlant,
    v: Array,
    *,
    noise: bool = True,
    seed: int | Sequence[int] = 0,
    places: Array = COILS,
) -> tuple[Array, Array]:
    """Fly excitation v (N, 3) in closed loop from rest; return pose y and wrench u, (N, 3).

    `places` (P, 3): rows y, x, 1 of the coils, and of the sensors under them.
    """
    rng = np.random.default_rng(seed)
    n, points = len(v), len(places)
    if noise:
        sensor = rng.normal(0.0, SENSOR_NOISE_M, (n, points))
        held = COIL_NOISE_N * np.sqrt(COIL_NOISE_HELD_S / plant.Ts_s)
        wrench = rng.normal(0.0, held, (n, points)) @ places
        step = SENSOR_STEP_M
    else:
        sensor, wrench, step = np.zeros((n, points)), np.zeros((n, 3)), 0.0
    ki, inverse = KI * plant.Ts_s, np.linalg.pinv(places)
    return _loop(plant.A, plant.B, plant.C, places, inverse, KP, ki, v, sensor, wrench, step)


def fly_limited(
    plant: SampledPlant, v: Array, limit_n: float, seed: int = 0
) -> tuple[Array, Array, Array, Array]:
    """Fly v (N, 3) like `simulate` with coil forces within +-limit_n; 7.63 N carry the weight.

    Return pose y, the commanded wrench and its feed-forward (N, 3), and the coil forces (N, 9).
    The integrators are held while a coil is at its limit.
    """
    rng, n = np.random.default_rng(seed), len(v)
    sensor = rng.normal(0.0, SENSOR_NOISE_M, (n, 9))
    held = COIL_NOISE_N * np.sqrt(COIL_NOISE_HELD_S / plant.Ts_s)
    wrench = rng.normal(0.0, held, (n, 9)) @ COILS
    ff = np.tile([0.0, 0.0, 7.0 * 9.81], (n, 1))
    y, tau, coil = _limited_loop(
        plant.A, plant.B, plant.C, COILS, T, KP, KI * plant.Ts_s, v, sensor, wrench, SENSOR_STEP_M,
        ff[0], limit_n,
    )  # fmt: skip
    return y, tau, ff, coil


def records(
    beams_m: Sequence[float],
    rate_hz: float,
    duration_s: float,
    seed: int = 0,
    *,
    noise: bool = True,
    at_rest: bool = True,
) -> list[Record]:
    """Return a record of white noise at each input for each position, flown from rest.

    Names are psi-0, theta-0, z-0, psi-1, ... by input and position. The power density of the
    excitation is the same at any rate. `at_rest`: the value of the records' field `at_rest`.
    """
    controller, found = PiController(KP, KI), []
    for b, x_b_m in enumerate(beams_m):
        plant = sampled_plant(x_b_m, 1 / rate_hz)
        for axis, name in enumerate(NAMES):
            excitation, sensors = [seed, b, axis, 0], [seed, b, axis, 1]
            v = np.zeros((round(duration_s * rate_hz), 3))
            rms = EXCITATION_RMS[axis] * np.sqrt(rate_hz / 1e3)
            v[:, axis] = np.random.default_rng(excitation).normal(0.0, rms, len(v))
            y, u = simulate(plant, v, noise=noise, seed=sensors)
            found.append(
                Record(
                    f"{name}-{b}", 1 / rate_hz, v, y, NAMES, UNITS_IN, NAMES, UNITS_OUT, u=u,
                    beam_m=x_b_m, controller=controller, delay_cycles=1, at_rest=at_rest,
                )
            )  # fmt: skip
    return found


@numba.njit(cache=True)  # type: ignore[untyped-decorator]
def _loop(A, B, C, S, T, kp, ki, v, sensor, wrench, step):  # type: ignore[no-untyped-def]
    n = len(v)
    y, u = np.zeros((n, 3)), np.zeros((n, 3))
    x, integral, acting = np.zeros(len(A)), np.zeros(3), np.zeros(3)
    for k in range(n):
        gap = S @ (C @ x) + sensor[k]
        if step > 0.0:
            gap = np.round(gap / step) * step
        y[k] = T @ gap
        integral -= ki * y[k]
        u[k] = v[k] - kp * y[k] + integral
        x = A @ x + B @ (acting + wrench[k])
        acting = u[k].copy()
    return y, u


@numba.njit(cache=True)  # type: ignore[untyped-decorator]
def _limited_loop(  # type: ignore[no-untyped-def]
    A, B, C, S, T, kp, ki, v, sensor, wrench, step, ff, limit
):
    n = len(v)
    y, tau, coil = np.zeros((n, 3)), np.zeros((n, 3)), np.zeros((n, len(S)))
    x, integral, acting = np.zeros(len(A)), np.zeros(3), np.zeros(3)
    for k in range(n):
        gap = np.round((S @ (C @ x) + sensor[k]) / step) * step
        y[k] = T @ gap
        tau[k] = v[k] - kp * y[k] + integral - ki * y[k] + ff
        force = T.T @ tau[k]
        coil[k] = np.minimum(np.maximum(force, -limit), limit)
        if np.all(coil[k] == force):
            integral -= ki * y[k]
        x = A @ x + B @ (acting + wrench[k])
        acting = S.T @ coil[k] - ff
    return y, tau, coil
