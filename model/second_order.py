"""A second-order model at one operating point: state space (7)-(8), discretisation, response."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm

Array = NDArray[np.float64]


@dataclass(frozen=True)
class SecondOrder:
    """M q'' + D q' + K q = B u(t - delay, lagged) + force, for n DOF and p inputs.

    M, D, K (n, n), B (n, p), force (n,) in SI units; lag_s is the time constant of a first-order
    lag of every input, delay_s a pure delay.
    """

    M: Array
    D: Array
    K: Array
    B: Array
    force: Array
    lag_s: float = 0.0
    delay_s: float = 0.0


@dataclass(frozen=True)
class StateSpace:
    """x(k+1) = A x + B u, y = C x + D u with sampling time Ts_s; continuous when Ts_s is 0."""

    A: Array
    B: Array
    C: Array
    D: Array
    Ts_s: float

    def response(self, freq_hz: Array) -> NDArray[np.complex128]:
        """Return the frequency response (F, m, p) at freq_hz (F,)."""
        s = 2j * np.pi * np.asarray(freq_hz, float)
        points = np.exp(s * self.Ts_s) if self.Ts_s > 0 else s
        n = len(self.A)
        shifted = points[:, None, None] * np.eye(n) - self.A
        return np.asarray(
            self.C @ np.linalg.solve(shifted, np.broadcast_to(self.B, (len(points), *self.B.shape)))
            + self.D
        )


def state_space(model: SecondOrder) -> StateSpace:
    """Return (8): states [q, q'] (2n), input u before lag and delay are applied, output q."""
    n, p = model.B.shape
    zero, eye = np.zeros((n, n)), np.eye(n)
    M_inv = np.linalg.solve(model.M, np.hstack([-model.K, -model.D, model.B]))
    A = np.block([[zero, eye], [M_inv[:, :n], M_inv[:, n : 2 * n]]])
    B = np.vstack([np.zeros((n, p)), M_inv[:, 2 * n :]])
    return StateSpace(A, B, np.hstack([eye, zero]), np.zeros((n, p)), 0.0)


def discretise(model: SecondOrder, Ts_s: float) -> StateSpace:
    """Return the model sampled at Ts_s, its input held over each period, lag and delay exact.

    States are [q, q', lagged inputs (when there is a lag), past inputs (for the delay)]. A delay of
    d periods and a fraction is exact too: the held input changes within the period, so the step is
    split there.
    """
    n, p = model.B.shape
    plant = state_space(model)
    if model.lag_s > 0:
        A = np.block([[plant.A, plant.B], [np.zeros((p, 2 * n)), -np.eye(p) / model.lag_s]])
        B = np.vstack([np.zeros((2 * n, p)), np.eye(p) / model.lag_s])
    else:
        A, B = plant.A, plant.B
    whole = int(np.floor(model.delay_s / Ts_s + 1e-9))
    late_s = max(model.delay_s - whole * Ts_s, 0.0)
    if late_s < 1e-9 * Ts_s:
        late_s = 0.0
    # u(k - whole - 1) acts until late_s into the period, u(k - whole) from there on.
    A_first, B_first = held_step(A, B, late_s)
    A_second, B_second = held_step(A, B, Ts_s - late_s)
    A_step, B_new, B_old = A_second @ A_first, B_second, A_second @ B_first
    m, depth = len(A), whole + (late_s > 0)
    size = m + depth * p
    Ad, Bd = np.zeros((size, size)), np.zeros((size, p))
    Ad[:m, :m] = A_step

    def tap(d: int) -> slice:
        return slice(m + (d - 1) * p, m + d * p)

    if whole == 0:
        Bd[:m] = B_new
    else:
        Ad[:m, tap(whole)] = B_new
    if late_s > 0:
        Ad[:m, tap(whole + 1)] = B_old
    if depth:
        Bd[tap(1)] = np.eye(p)
    for d in range(2, depth + 1):
        Ad[tap(d), tap(d - 1)] = np.eye(p)
    C = np.hstack([np.eye(n), np.zeros((n, size - n))])
    return StateSpace(Ad, Bd, C, np.zeros((n, p)), Ts_s)


def held_step(A: Array, B: Array, step_s: float) -> tuple[Array, Array]:
    """Return (Ad, Bd) of x' = A x + B u over step_s with u held (Van Loan's block exponential)."""
    n, p = B.shape
    block = np.zeros((n + p, n + p))
    block[:n, :n], block[:n, n:] = A, B
    Phi = expm(block * step_s)
    return Phi[:n, :n], Phi[:n, n:]
