"""A platform that bends, with a beam that slips in its bearing: flown by equations of its own.

It shares no code with the simulator or the model: linear equations of motion, integrated exactly
over 0.1 ms, and the yielding of the bearing as a force on them. Modes are orthogonal to rigid
motion, have a shape over the nine places of coils and sensors, and are seen through T.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm

from levid.identification.covariance_scaling import correlation
from levid.identification.greybox.experiment.control_loop import ControlLoop
from levid.identification.greybox.experiment.experiment_from_log import Experiment
from levid.identification.greybox.experiment.sensor_readings import SensorReadings
from levid.model.controller import pi_controller

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

R_M, G = 0.12, 9.81
COILS = np.array([(y, x, 1.0) for x in (1, 0, -1) for y in (1, 0, -1)]) * [R_M, R_M, 1.0]
T = np.linalg.pinv(COILS)
KP, KI = np.array([20.0, 20.0, 500.0]), np.array([200.0, 200.0, 3000.0])
RMS = np.array([0.1, 0.1, 1.3])
"""Excitation of each input at 1 kHz."""
NOMINAL: Mapping[str, float] = {
    "m_p": 5.6, "m_b": 1.4, "z_b": 0.06, "J_psi": 0.062, "J_theta": 0.058, "J_psitheta": 0.0015,
    "d": 4.0, "k_psi": 210.0, "k_theta": 190.0, "k_z": 2600.0, "k_psitheta": 3.0, "k_psiz": 8.0,
    "k_thetaz": -6.0, "lag": 3e-4, "delay": 0.0,
}  # fmt: skip
SENSOR_NOISE_M, SENSOR_STEP_M, COIL_NOISE_N, STEP_S = 1e-7, 2e-3 / 65536, 1e-3, 1e-4
SPRINGS = 8
HIGHEST_HZ, PERIOD_S = 400.0, 2.0
"""Of the multisines."""


@dataclass(frozen=True)
class BendingMode:
    """One mode: the shape (9,) over the places has the maximum 1, the mass belongs to it."""

    freq_hz: float
    damping: float
    mass_kg: float
    shape: Array


@dataclass(frozen=True)
class Bearing:
    """The beam's bearing along x: stiffness of presliding, force at which it slips, damping."""

    stiffness_n_m: float
    slip_n: float = 4.0
    damping_n_s_m: float = 20.0


@dataclass(frozen=True)
class Platform:
    """The rig with modes and a bearing, None for a rigid one."""

    modes: tuple[BendingMode, ...] = ()
    bearing: Bearing | None = None

    def matrices(self, x_b_m: float) -> tuple[Array, Array, Array, Array, Array]:
        """Return A, B of coil forces (9), B of the bearing's yielding, C of gaps, and M q, q."""
        p, modes = NOMINAL, self.modes
        beam = int(self.bearing is not None)
        n = 3 + beam + len(modes)
        M, D, K = (np.zeros((n, n)) for _ in range(3))
        m_b, z_b = p["m_b"], p["z_b"]
        M[:3, :3] = [
            [p["J_psi"] + m_b * z_b**2, p["J_psitheta"], 0.0],
            [p["J_psitheta"], p["J_theta"] + m_b * (z_b**2 + x_b_m**2), m_b * x_b_m],
            [0.0, m_b * x_b_m, p["m_p"] + m_b],
        ]
        D[:3, :3] = np.diag([6 * R_M**2 * p["d"]] * 2 + [9 * p["d"]])
        tilt = z_b * m_b * G
        K[:3, :3] = [
            [p["k_psi"] - tilt, p["k_psitheta"], p["k_psiz"]],
            [p["k_psitheta"], p["k_theta"] - tilt, p["k_thetaz"]],
            [p["k_psiz"], p["k_thetaz"], p["k_z"]],
        ]
        B, C, yielding = np.zeros((n, 9)), np.zeros((9, n)), np.zeros((n, 1))
        B[:3], C[:, :3] = COILS.T, COILS
        if self.bearing is not None:
            k, c = self.bearing.stiffness_n_m, self.bearing.damping_n_s_m
            # Y is the beam's shift in space; delta = Y + z_b theta is the one in the bearing.
            M[1, 1] -= m_b * z_b**2
            M[3, 3] = m_b
            delta = np.array([z_b, 1.0])
            both = np.ix_([1, 3], [1, 3])
            K[both] += k * np.outer(delta, delta) + m_b * G * np.array([[2 * z_b, 1.0], [1.0, 0.0]])
            D[both] += c * np.outer(delta, delta)
            yielding[[1, 3], 0] = delta
        for i, mode in enumerate(modes, start=3 + beam):
            w = 2 * np.pi * mode.freq_hz
            M[i, i], D[i, i] = mode.mass_kg, 2 * mode.damping * w * mode.mass_kg
            K[i, i] = w**2 * mode.mass_kg
            B[i], C[:, i] = mode.shape, mode.shape
        inverse, Z = np.linalg.inv(M), np.zeros((n, n))
        A = np.block([[Z, np.eye(n)], [-inverse @ K, -inverse @ D]])
        return (
            A,
            np.vstack([np.zeros((n, 9)), inverse @ B]),
            np.vstack([np.zeros((n, 1)), inverse @ yielding]),
            np.hstack([C, np.zeros((9, n))]),
            M,
        )

    def response(self, x_b_m: float, freq_hz: Array) -> Complex:
        """Return the continuous response (F, 3, 3) from wrench to pose, without lag and delay.

        The bearing is that of small motions.
        """
        A, B, _, C, _ = self.matrices(x_b_m)
        s = 2j * np.pi * freq_hz[:, None, None]
        inner = np.linalg.solve(
            s * np.eye(len(A)) - A, np.broadcast_to(B @ T.T, (len(s), len(A), 3))
        )
        return np.asarray(T @ C @ inner)

    def sampled_response(self, x_b_m: float, freq_hz: Array, Ts_s: float) -> Complex:
        """Return the response (F, 3, 3) from u to y of the sampled loop, bearing as above.

        The command acts a cycle later, is held, and goes through the current loops.
        """
        A, B, _, C, _ = self.matrices(x_b_m)
        n, lag = len(A), NOMINAL["lag"]
        whole = np.block([[A, B], [np.zeros((9, n)), -np.eye(9) / lag]])
        inputs = np.vstack([np.zeros((n, 3)), T.T / lag])
        block = np.zeros((n + 12, n + 12))
        block[: n + 9, : n + 9], block[: n + 9, n + 9 :] = whole, inputs
        step = expm(block * Ts_s)
        z = np.exp(2j * np.pi * freq_hz * Ts_s)[:, None, None]
        inner = np.linalg.solve(
            z * np.eye(n + 9) - step[: n + 9, : n + 9],
            np.broadcast_to(step[: n + 9, n + 9 :], (len(z), n + 9, 3)),
        )
        return np.asarray(T @ np.hstack([C, np.zeros((9, 9))]) @ inner / z)


def drawn(seed: int) -> Platform:
    """Draw a platform of the paper's kind: a bearing, up to 3 modes of 60 to 300 Hz, 1 to 10 kg."""
    rng = np.random.default_rng(seed)
    x, y = COILS[:, 1] / R_M, COILS[:, 0] / R_M
    basis = np.array(
        [x * y, x * x - y * y, x * x + y * y - 1, 2 * x * (x * x - 0.6), 2 * y * (y * y - 0.6)]
    )
    modes = []
    for _ in range(rng.integers(0, 4)):
        shape = rng.normal(size=5) @ basis + 0.3 * rng.normal()
        freq_hz, mass_kg = np.exp(rng.uniform(np.log([60.0, 1.0]), np.log([300.0, 10.0])))
        damping = float(rng.uniform(0.005, 0.02))
        modes.append(BendingMode(freq_hz, damping, mass_kg, shape / np.abs(shape).max()))
    return Platform(tuple(modes), Bearing(float(np.exp(rng.uniform(np.log(1e5), np.log(1e6))))))


def flights(
    platform: Platform,
    seed: int,
    excitation: str = "noise",
    duration_s: float = 20.0,
    rate_hz: float = 1000.0,
    beams_m: Sequence[float] = (-0.1, 0.0, 0.1),
) -> list[Experiment]:
    """Fly a record for each input and beam position, with "noise" or a "multisine"."""
    Ts_s, found = 1.0 / rate_hz, []
    rows = round(duration_s * rate_hz)
    weight = np.array([0.0, 0.0, G * (NOMINAL["m_p"] + NOMINAL["m_b"])])
    for b, x_b_m in enumerate(beams_m):
        ff = weight + np.array([0.0, NOMINAL["m_b"] * G * x_b_m, 0.0])
        for axis in range(3):
            v = np.zeros((rows, 3))
            rng = np.random.default_rng([seed, b, axis, 0])
            v[:, axis] = RMS[axis] * _signal(excitation, rows, Ts_s, rng)
            y, u, gaps = _fly(platform, x_b_m, v, Ts_s, [seed, b, axis, 1])
            zero = np.zeros((rows, 3))
            loop = ControlLoop(v, zero, np.tile(ff, (rows, 1)), zero, pi_controller(KP, KI, Ts_s))
            found.append(
                Experiment(
                    f"{x_b_m:+g}-{axis}", Ts_s, u + ff, y,
                    {"x_b": np.full(rows, x_b_m), "v_b": np.zeros(rows), "a_b": np.zeros(rows)},
                    frozenset({"a_b"}), False, 1, loop, True, hold="zoh",
                    correlations=(correlation(COILS.T @ COILS), correlation(T @ T.T)),
                    spans={"x_b": 0.2, "v_b": 1.0, "a_b": 1.0},
                    readings=SensorReadings(
                        gaps.astype(np.float32), COILS[:, [1, 0]], COILS[:, [1, 0]], COILS, COILS
                    ),
                )
            )  # fmt: skip
    return found


def _signal(excitation: str, rows: int, Ts_s: float, rng: np.random.Generator) -> Array:
    if excitation == "noise":
        return rng.normal(0.0, np.sqrt(1e-3 / Ts_s), rows)
    period = round(PERIOD_S / Ts_s)
    lines = np.arange(1, round(HIGHEST_HZ * PERIOD_S) + 1)
    spectrum = np.zeros(period // 2 + 1, complex)
    spectrum[lines] = np.exp(2j * np.pi * rng.random(len(lines)))
    wave = np.fft.irfft(spectrum, period)
    return np.tile(wave / wave.std(), rows // period + 1)[:rows]


def _fly(
    platform: Platform, x_b_m: float, v: Array, Ts_s: float, seed: Sequence[int]
) -> tuple[Array, Array, Array]:
    rng, substeps = np.random.default_rng(seed), round(Ts_s / STEP_S)
    A, B, yielding, C, _ = platform.matrices(x_b_m)
    n, lag = len(A), NOMINAL["lag"]
    # States: motion, then the nine currents; inputs: command, amplifier noise, yielding.
    whole = np.block([[A, B], [np.zeros((9, n)), -np.eye(9) / lag]])
    inputs = np.zeros((n + 9, 19))
    inputs[n:, :9], inputs[:n, 9:18], inputs[:n, 18:] = np.eye(9) / lag, B, yielding
    block = np.zeros((n + 28, n + 28))
    block[: n + 9, : n + 9], block[: n + 9, n + 9 :] = whole, inputs
    step = expm(block * STEP_S)
    k, yields = 0.0, np.zeros(0)
    if platform.bearing is not None:
        k = platform.bearing.stiffness_n_m
        # Eight springs with slips evenly spread from 0 to 2 W / k (Iwan 1966).
        yields = 2 * platform.bearing.slip_n / k * (np.arange(SPRINGS) + 0.5) / SPRINGS
    return _loop(
        np.ascontiguousarray(step[: n + 9, : n + 9]),
        np.ascontiguousarray(step[: n + 9, n + 9 :]),
        np.hstack([C, np.zeros((9, 9))]),
        T, KP, KI * Ts_s, v,
        rng.normal(0.0, SENSOR_NOISE_M, (len(v), 9)),
        rng.normal(0.0, COIL_NOISE_N, (len(v) * substeps, 9)),
        SENSOR_STEP_M, substeps, k, yields, NOMINAL["z_b"], n // 2,
    )  # fmt: skip


@numba.njit(cache=True)  # type: ignore[untyped-decorator]
def _loop(  # type: ignore[no-untyped-def]
    A, B, C, T, kp, ki, v, sensor, amplifier, step, substeps, k, yields, z_b, rates
):
    n, springs = len(v), len(yields)
    y, u, gaps = np.zeros((n, 3)), np.zeros((n, 3)), np.zeros((n, 9))
    x, integral, inputs = np.zeros(len(A)), np.zeros(3), np.zeros(19)
    strain, last = np.zeros(springs), 0.0
    for i in range(n):
        gaps[i] = np.round((C @ x + sensor[i]) / step) * step
        y[i] = T @ gaps[i]
        integral -= ki * y[i]
        u[i] = v[i] - kp * y[i] + integral
        for j in range(substeps):
            inputs[9:18] = amplifier[i * substeps + j]
            if springs > 0:
                # In the middle of the step, as the force is held over it.
                delta = x[3] + z_b * x[1] + 0.5e-4 * (x[rates + 3] + z_b * x[rates + 1])
                strain = np.minimum(np.maximum(strain + delta - last, -yields), yields)
                last = delta
                inputs[18] = k * delta - k / springs * strain.sum()
            x = A @ x + B @ inputs
        inputs[:9] = T.T @ u[i]
    return y, u, gaps
