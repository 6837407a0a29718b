"""Second-order model at one operating point: state space (7)-(8), discretisation, response."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

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

    def response(self, freq_hz: Array, delay_s: float = 0.0) -> NDArray[np.complex128]:
        """Return the frequency response (F, m, p) at freq_hz (F,), with a delay of the inputs."""
        s = 2j * np.pi * np.asarray(freq_hz, float)
        points = np.exp(s * self.Ts_s) if self.Ts_s > 0 else s
        n = len(self.A)
        shifted = points[:, None, None] * np.eye(n) - self.A
        H = self.C @ np.linalg.solve(shifted, np.broadcast_to(self.B, (len(s), *self.B.shape)))
        return np.asarray((H + self.D) * np.exp(-s * delay_s)[:, None, None])


def state_space(model: SecondOrder) -> StateSpace:
    """Return the state space (8): states [q, q'] (2n), output q; without lag and delay of u."""
    n, p = model.B.shape
    zero, eye = np.zeros((n, n)), np.eye(n)
    M_inv = np.linalg.solve(model.M, np.hstack([-model.K, -model.D, model.B]))
    A = np.block([[zero, eye], [M_inv[:, :n], M_inv[:, n : 2 * n]]])
    B = np.vstack([np.zeros((n, p)), M_inv[:, 2 * n :]])
    return StateSpace(A, B, np.hstack([eye, zero]), np.zeros((n, p)), 0.0)


def lagged(model: SecondOrder) -> StateSpace:
    """Return state_space(model) plus the lagged inputs (p) as states, if there is a lag."""
    plant = state_space(model)
    if model.lag_s <= 0:
        return plant
    n, p = plant.B.shape
    A = np.block([[plant.A, plant.B], [np.zeros((p, n)), -np.eye(p) / model.lag_s]])
    B = np.vstack([np.zeros((n, p)), np.eye(p) / model.lag_s])
    return StateSpace(A, B, np.hstack([plant.C, np.zeros((len(plant.C), p))]), plant.D, 0.0)


def discretise(model: SecondOrder, Ts_s: float, hold: Literal["zoh", "foh"] = "zoh") -> StateSpace:
    """Return the model discretised with Ts_s; lag and delay are exact.

    The input is held over each period (zoh) or linear between samples (foh). With foh, D is not
    zero, and the states exclude the contribution of the present input. The states are [q, q',
    lagged inputs (if there is a lag), past inputs (for the delay)]. A delay of a fraction of a
    period is exact too: the step is split where the delayed input changes.
    """
    n, p = model.B.shape
    plant = lagged(model)
    whole = int(np.floor(model.delay_s / Ts_s + 1e-9))
    late_s = max(model.delay_s - whole * Ts_s, 0.0)
    if late_s < 1e-9 * Ts_s:
        late_s = 0.0
    m, depth = len(plant.A), whole + (late_s > 0)
    with np.errstate(over="ignore", invalid="ignore"):  # no numbers for absurd parameters
        A_step, effects = _step(plant.A, plant.B, Ts_s, late_s, hold)
    size = m + depth * p
    Ad, Bd = np.zeros((size, size)), np.zeros((size, p))
    C, D = np.hstack([np.eye(n), np.zeros((n, size - n))]), np.zeros((n, p))
    Ad[:m, :m] = A_step

    def tap(d: int) -> slice:
        return slice(m + (d - 1) * p, m + d * p)

    for d, effect in zip((whole + 1, whole, whole - 1), effects, strict=True):
        if 1 <= d <= depth:
            Ad[:m, tap(d)] = effect
        elif d == 0:
            Bd[:m] += effect
        elif d == -1:  # effect of the next input: added one row later, and to the output via D
            Bd[:m] += A_step @ effect
            D = effect[:n]
    if depth:
        Bd[tap(1)] = np.eye(p)
    for d in range(2, depth + 1):
        Ad[tap(d), tap(d - 1)] = np.eye(p)
    return StateSpace(Ad, Bd, C, D, Ts_s)


def _step(
    A: Array, B: Array, Ts_s: float, late_s: float, hold: Literal["zoh", "foh"]
) -> tuple[Array, tuple[Array, Array, Array]]:
    """Return the transition matrix over a period and the effects of three inputs on the state.

    The delayed input changes `late_s` after the begin of the period. The three inputs are the one
    before this change, the one after it, and the next one.
    """
    rest_s = Ts_s - late_s
    if hold == "zoh":
        (A_first, B_first), (A_second, B_second) = held_step(A, B, late_s), held_step(A, B, rest_s)
        return A_second @ A_first, (A_second @ B_first, B_second, np.zeros_like(B))
    A_first, B_first, R_first = ramped_step(A, B, late_s)
    A_second, B_second, R_second = ramped_step(A, B, rest_s)
    # At the begin of the period the line from old to new is this share before new.
    share, R_first, R_second = late_s / Ts_s, R_first / Ts_s, R_second / Ts_s
    old = A_second @ (share * B_first - R_first)
    new = A_second @ ((1.0 - share) * B_first + R_first) + B_second - R_second
    return A_second @ A_first, (old, new, R_second)


def held_step(A: Array, B: Array, step_s: float) -> tuple[Array, Array]:
    """Return (Ad, Bd) of x' = A x + B u over step_s with u held (Van Loan's block exponential)."""
    n, p = B.shape
    block = np.zeros((n + p, n + p))
    block[:n, :n], block[:n, n:] = A, B
    Phi = expm(block * step_s)
    return Phi[:n, :n], Phi[:n, n:]


def ramped_step(A: Array, B: Array, step_s: float) -> tuple[Array, Array, Array]:
    """Return (Ad, Bd, Rd) of x' = A x + B (u + r t) over step_s; Rd belongs to the slope r."""
    n, p = B.shape
    block = np.zeros((n + 2 * p, n + 2 * p))
    block[:n, :n], block[:n, n : n + p] = A * step_s, B * step_s
    block[n : n + p, n + p :] = np.eye(p)  # time in units of step_s avoids tiny entries
    Phi = expm(block)
    return Phi[:n, :n], Phi[:n, n : n + p], Phi[:n, n + p :] * step_s
