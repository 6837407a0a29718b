"""Compiled rows of a discrete controller, see `Controller`."""

from __future__ import annotations

import numpy as np
from numba import njit


@njit(cache=True, nogil=True)
def controller_row(A, B, C, D, L, low, high, w, v, x, following, u):  # type: ignore[no-untyped-def]
    """Compute the commands u (p,) of one row, and advance the state x (s,) in place.

    w (r + n,), v (p,); following (s,) is scratch.
    """
    s, p, m = len(x), len(v), len(w)
    for i in range(s):
        total = 0.0
        for j in range(s):
            total += A[i, j] * x[j]
        for j in range(m):
            total += B[i, j] * w[j]
        following[i] = total
    for i in range(p):
        total = v[i]
        for j in range(s):
            total += C[i, j] * x[j]
        for j in range(m):
            total += D[i, j] * w[j]
        u[i] = min(max(total, low[i]), high[i])
        excess = u[i] - total
        if excess != 0.0:
            for j in range(s):
                following[j] += L[j, i] * excess
    for i in range(s):
        x[i] = following[i]


@njit(cache=True, nogil=True)
def run_rows(A, B, C, D, L, low, high, w, v, x, u):  # type: ignore[no-untyped-def]
    """Compute the commands u (N, p) of rows w (N, r + n) and v (N, p), and advance the state x."""
    following = np.empty(len(x))
    for k in range(len(w)):
        controller_row(A, B, C, D, L, low, high, w[k], v[k], x, following, u[k])
