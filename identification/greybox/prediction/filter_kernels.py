"""Compiled filters over a record: innovations filter, gains along a schedule, closed loop.

All step a second-order model by the Taylor series of its exact solution: over one period the
state x = [q, q'] becomes sum_j A^j (Ts^j / j! x + B m_j + g_j), with m_j the moments of the input
over the period (intersample_input.py) and g_j those of the schedule's force. They are in one file
because the compiler's cache depends on a function's own file only; after a change of
`controller_row`, touch this file.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from ....model.controller_kernels import controller_row

Array = NDArray[np.float64]

STILL, STILL_ROWS = 1e-14, 64
"""A column that changes by less than this share in so many rows is stationary."""
TINY = 1e-150
"""Smaller states are set to zero: processors are slow with denormal numbers."""


@njit(cache=True, nogil=True)
def innovations_fixed(  # type: ignore[no-untyped-def]
    Phi: Array, gain: Array, forcing: Array, y: Array, x: Array, out: Array
):
    """Fill `out` (N, m) with y - C x of the filter x(k+1) = Phi (x + gain e) + forcing(k).

    Phi (2n, 2n), gain (2n, m), forcing (N, 2n), y (N, m); C selects the first m states. `x` (2n,)
    is the state at row 0 on entry, and the predicted state after the last row on return.
    """
    size, m = len(x), y.shape[1]
    updated = np.empty(size)
    for k in range(len(y)):
        for i in range(size):
            updated[i] = x[i]
        for j in range(m):
            error = y[k, j] - x[j]
            out[k, j] = error
            for i in range(size):
                updated[i] += gain[i, j] * error
        for i in range(size):
            total = forcing[k, i]
            for j in range(size):
                total += Phi[i, j] * updated[j]
            x[i] = total


@njit(cache=True, nogil=True, fastmath={"contract", "reassoc"})
def errors_and_unknowns(Phi, gain, forcing, steady, y, out):  # type: ignore[no-untyped-def]  # noqa: PLR0912
    """Fill `out` (N, m, 1 + c + 2n): errors from a zero state, and the effects of unknowns.

    The filter of innovations_fixed for many columns in one pass: the record's errors, then c
    constant inputs that add steady (2n, c) in each period, then a unit of each state at row 0. Once
    the effects of the unknowns are stationary, only the errors are filtered.
    """
    rows, m = y.shape
    size, constants = steady.shape
    columns = 1 + constants + size
    correction = Phi @ gain
    x, following = np.zeros((size, columns)), np.empty((size, columns))
    before = np.full((size, columns), np.inf)
    moving = columns
    for i in range(size):
        x[i, 1 + constants + i] = 1.0
    for k in range(rows):
        for i in range(m):
            for c in range(moving):
                out[k, i, c] = -x[i, c]
            for c in range(moving, columns):
                out[k, i, c] = out[k - 1, i, c]
            out[k, i, 0] += y[k, i]
        for i in range(size):
            following[i, 0] = forcing[k, i]
            for c in range(1, moving):
                following[i, c] = steady[i, c - 1] if c <= constants else 0.0
            for j in range(size):
                factor = Phi[i, j]
                for c in range(moving):
                    following[i, c] += factor * x[j, c]
            for j in range(m):
                factor = correction[i, j]
                for c in range(moving):
                    following[i, c] += factor * out[k, j, c]
        for i in range(size):
            for c in range(moving):
                x[i, c] = following[i, c]
        if moving > 1 and k % STILL_ROWS == STILL_ROWS - 1:
            still = True
            for i in range(size):
                for c in range(1, columns):
                    # The effect of an initial state decays to zero: compare it with its unit.
                    whole = max(abs(x[i, c]), STILL) if c > constants else abs(x[i, c])
                    if not abs(x[i, c] - before[i, c]) <= STILL * whole:
                        still = False
                    before[i, c] = x[i, c]
                    if abs(x[i, c]) < TINY:
                        x[i, c] = 0.0
            if still:
                moving = 1


@njit(cache=True, nogil=True)
def flow(K, D, B, x, moments, drift, scale, work, top):  # type: ignore[no-untyped-def]
    """Advance the state `x` (2n,) by one period, by Horner's scheme on the Taylor series.

    K, D (n, n) and B (n, p) are divided by M; moments (J, p); drift (J, n) moments of the
    force; scale (J + 1,) is Ts^j / j!; work, top (2n,) are scratch.
    """
    n, p, order = len(K), B.shape[1], len(moments)
    for i in range(2 * n):
        work[i] = scale[order] * x[i]
    for j in range(order - 1, -1, -1):
        for i in range(n):
            total = 0.0
            for a in range(n):
                total -= K[i, a] * work[a] + D[i, a] * work[n + a]
            top[i] = work[n + i]
            top[n + i] = total
        for i in range(n):
            total = drift[j, i]
            for a in range(p):
                total += B[i, a] * moments[j, a]
            top[n + i] += total
        for i in range(2 * n):
            work[i] = top[i] + scale[j] * x[i]
    for i in range(2 * n):
        x[i] = work[i]


@njit(cache=True, nogil=True)
def innovations_along(K, D, B, drift, gain, moments, scale, y, x, out):  # type: ignore[no-untyped-def]
    """Fill `out` (N, m) as innovations_fixed does, for a model that changes between periods.

    K, D (N, n, n), B (N, n, p), divided by M, are those in the middle of each period; drift
    (N, J, n); gain (N, 2n, m); moments (N, J, p); scale (J + 1,).
    """
    size, m = len(x), y.shape[1]
    work, top = np.empty(size), np.empty(size)
    for k in range(len(y)):
        for j in range(m):
            out[k, j] = y[k, j] - x[j]
        for j in range(m):
            for i in range(size):
                x[i] += gain[k, i, j] * out[k, j]
        flow(K[k], D[k], B[k], x, moments[k], drift[k], scale, work, top)
        if k % STILL_ROWS == 0:
            for i in range(size):
                if abs(x[i]) < TINY:
                    x[i] = 0.0


@njit(cache=True, nogil=True)
def gains_along(K, D, scale, Q, R, P0, gain, S_out):  # type: ignore[no-untyped-def]
    """Fill gains (N, 2n, m) and innovation covariances (N, m, m) of a time-varying Kalman filter.

    Q (N, 2n, 2n): process covariance; R (m, m): measurement covariance; P0 (2n, 2n): covariance of
    the initial state.
    """
    size, m = len(P0), len(R)
    n = size // 2
    P = P0.copy()
    Phi = np.empty((size, size))
    unit, work, top = np.zeros(size), np.empty(size), np.empty(size)
    nothing, no_drift, no_input = (
        np.zeros((len(scale) - 1, 1)), np.zeros((len(scale) - 1, n)), np.zeros((n, 1)),
    )  # fmt: skip
    for k in range(len(K)):
        S = P[:m, :m] + R
        top_rows = np.ascontiguousarray(P[:m, :])
        L = np.ascontiguousarray(np.linalg.solve(S, top_rows).T)
        gain[k] = L
        S_out[k] = S
        P = P - L @ top_rows
        for i in range(size):
            unit[:] = 0.0
            unit[i] = 1.0
            flow(K[k], D[k], no_input, unit, nothing, no_drift, scale, work, top)
            Phi[:, i] = unit
        P = Phi @ P @ Phi.T + Q[k]
        P = 0.5 * (P + P.T)


@njit(cache=True, nogil=True)
def closed_loop_along(  # type: ignore[no-untyped-def]
    K, D, B, drift, scale, v, ref, known, seen, A_c, B_c, C_c, D_c, L_c, low, high, first, whole,
    from_old, from_new, from_lag, end, x, state, lag, y, u,
):  # fmt: skip
    """Simulate the closed loop from row `first` on, without measurements.

    The command u = known + C(ref, y + seen, v) of every row acts `whole` periods and a fraction
    later, after the lag (intersample_input.HeldStep: from_*, end = [old, new, lag]). The controller
    is that of model.controller; its limits do not apply to `known`. v, known (N, p), ref (N, r),
    seen (N, n). x (2n,), state (s,) and lag (p,) are those of plant, controller and lag at row
    `first`, and are changed. K, D, B, drift have one row for each period or a single one. y (N, n)
    and u (N, p) contain the rows before `first`; the others are filled.
    """
    n, p = K.shape[1], B.shape[2]
    work, top = np.empty(2 * n), np.empty(2 * n)
    moments = np.empty((len(from_old), p))
    r = ref.shape[1]
    w, following, command = np.empty(r + n), np.empty(len(state)), np.empty(p)
    for k in range(first, len(v)):
        at = min(k, len(K) - 1)
        for i in range(n):
            y[k, i] = x[i]
            w[r + i] = x[i] + seen[k, i]
        for i in range(r):
            w[i] = ref[k, i]
        controller_row(A_c, B_c, C_c, D_c, L_c, low, high, w, v[k], state, following, command)
        for i in range(p):
            u[k, i] = command[i] + known[k, i]
        for i in range(p):
            new, old = u[max(k - whole, 0), i], u[max(k - whole - 1, 0), i]
            for j in range(len(moments)):
                moments[j, i] = from_old[j] * old + from_new[j] * new + from_lag[j] * lag[i]
            lag[i] = end[0] * old + end[1] * new + end[2] * lag[i]
        flow(K[at], D[at], B[at], x, moments, drift[min(k, len(drift) - 1)], scale, work, top)
