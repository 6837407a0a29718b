"""Fit the measured inverted pendulum by maximum likelihood, without levid's code.

The model is [[a, c], [c, j]] q'' + [[da, 0], [0, 0]] q' + [[0, 0], [0, -k]] q = [gain, 0] u, with
constant and white forces, white noise of both angles, and a voltage that is held between samples. A
steady-state Kalman filter gives the prediction errors. They are linear in the initial state and the
constant forces, so least squares finds these exactly.
"""

from __future__ import annotations

import numpy as np
from scipy.linalg import expm, solve_discrete_are
from scipy.optimize import minimize

TS_S = 0.002
COUNT_RAD = 2 * np.pi / 2048
QUANTISATION_RAD2 = COUNT_RAD**2 / 12
K_N_M = 0.015186
NAMES = ("gain", "a", "c", "j", "da")
START = np.array([5e-3, 4e-4, 1e-4, 1.3e-4, 2e-4])
FORCE_PSD = 1e-8


def transition(values: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return F (4, 4), the column of the voltage (4,), and those of two constant torques (4, 2)."""
    gain, a, c, j, da = values
    inverse = np.linalg.inv([[a, c], [c, j]])
    flow = np.zeros((7, 7))
    flow[:2, 2:4] = np.eye(2)
    flow[2:4, :2] = inverse @ np.diag([0.0, K_N_M])
    flow[2:4, 2:4] = -inverse @ np.diag([da, 0.0])
    flow[2:4, 4] = inverse[:, 0] * gain
    flow[2:4, 5:] = inverse
    step = expm(flow * TS_S)
    return step[:4, :4], step[:4, 4], step[:4, 5:]


def negative_log_likelihood(x: np.ndarray, voltage: np.ndarray, angles: np.ndarray) -> float:
    """Return it for logarithms x (9,): five parameters, two force and two output noise levels."""
    F, of_voltage, of_torque = transition(START * np.exp(x[:5]))
    H = np.eye(2, 4)
    R = np.diag(QUANTISATION_RAD2 * np.exp(x[7:]))
    Q = of_torque @ np.diag(FORCE_PSD * np.exp(x[5:7]) / TS_S) @ of_torque.T
    P = solve_discrete_are(F.T, H.T, Q, R)
    S = H @ P @ H.T + R
    gain = F @ P @ H.T @ np.linalg.inv(S)
    closed, driven = F - gain @ H, angles @ gain.T + np.outer(voltage, of_voltage)
    # Columns: the known drive, four of the initial state, two of the constant forces.
    state = np.zeros((4, 7))
    state[:, 1:5] = np.eye(4)
    constant = np.zeros((4, 7))
    constant[:, 5:] = of_torque
    predicted = np.empty((len(angles), 2, 7))
    for row, drive in enumerate(driven):
        predicted[row] = state[:2]
        state = closed @ state + constant
        state[:, 0] += drive
    whiten = np.linalg.inv(np.linalg.cholesky(S))
    errors = ((angles - predicted[:, :, 0]) @ whiten.T).ravel()
    columns = np.einsum("ij,njk->nik", whiten, predicted[:, :, 1:]).reshape(-1, 6)
    errors = errors - columns @ np.linalg.lstsq(columns, errors, rcond=None)[0]
    return float(0.5 * len(angles) * np.linalg.slogdet(S)[1] + 0.5 * errors @ errors)


def fit(voltage: np.ndarray, angles: np.ndarray) -> tuple[dict[str, float], np.ndarray]:
    """Return the parameters and the variances of the two outputs' noise in rad2."""
    found = minimize(
        negative_log_likelihood, np.zeros(9), (voltage, angles), "Powell", options={"ftol": 1e-7}
    )
    values = dict(zip(NAMES, START * np.exp(found.x[:5]), strict=True))
    return values, QUANTISATION_RAD2 * np.exp(found.x[7:])
