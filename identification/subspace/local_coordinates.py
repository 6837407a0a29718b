"""Move a state-space model in the directions that change its response.

It has n^2 more parameters than its response. Only directions perpendicular to a change of
coordinates of the state count (McKelvey, Helmersson and Ribarits, *Data driven local coordinates*,
Automatica 40, 2004).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_discrete_lyapunov

from ...model.second_order import StateSpace

Array = NDArray[np.float64]


def moved(model: StateSpace, change: Array) -> StateSpace:
    """Return the model after a change (n + m, n + p) of [A B; C D]."""
    n = len(model.A)
    return replace(
        model,
        A=model.A + change[:n, :n],
        B=model.B + change[:n, n:],
        C=model.C + change[n:, :n],
        D=model.D + change[n:, n:],
    )


def normalised(model: StateSpace) -> StateSpace:
    """Return the model in balanced coordinates of the state, as far as it has them.

    States that are hardly reachable or observable have a lower bound on their scale.
    """
    try:
        reach = solve_discrete_lyapunov(model.A, model.B @ model.B.T)
        observe = solve_discrete_lyapunov(model.A.T, model.C.T @ model.C)
    except np.linalg.LinAlgError:
        return model
    roots = []
    for gramian in (reach, observe):
        values, vectors = np.linalg.eigh((gramian + gramian.T) / 2)
        roots.append(vectors * np.sqrt(np.maximum(values, 1e-12 * values[-1])))
    U, s, Vt = np.linalg.svd(roots[1].T @ roots[0])
    if not np.all(np.isfinite(s)) or s[0] <= 0.0:
        return model
    half = np.sqrt(np.maximum(s, 1e-12 * s[0]))
    to_old = roots[0] @ Vt.T / half
    to_new = (U / half).T @ roots[1].T
    return replace(model, A=to_new @ model.A @ to_old, B=to_new @ model.B, C=model.C @ to_old)


def truncated(model: StateSpace, order: int) -> StateSpace:
    """Return the model without the states that matter least, those last in balanced coordinates."""
    found = normalised(model)
    return replace(
        found, A=found.A[:order, :order], B=found.B[:order], C=found.C[:, :order], D=found.D
    )


def response_directions(model: StateSpace, direct: NDArray[np.bool_]) -> Array:
    """Return an orthonormal basis (r, n + m, n + p) of the changes that alter the response."""
    n, m, p = len(model.A), len(model.C), model.B.shape[1]
    # A change of coordinates T alters A by T A - A T, B by T B and C by -C T.
    # same[i, j] is that of T with a single one, in row i and column j.
    same = np.zeros((n, n, n + m, n + p))
    for i in range(n):
        same[i, :, i, :n] += model.A
        same[i, :, i, n:] = model.B
        same[:, i, :n, i] -= model.A.T
        same[:, i, n:, i] = -model.C.T
    free = np.ones((n + m, n + p), bool)
    free[n:, n:] = direct
    kept = same.reshape(n * n, n + m, n + p)[:, free]
    Q = np.linalg.qr(kept.T, mode="complete")[0]
    basis = Q[:, n * n :].T
    found = np.zeros((len(basis), n + m, n + p))
    found[:, free] = basis
    return found
