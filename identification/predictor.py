"""An innovation model from input and output: observer Markov parameters, weighted SVD, Riccati."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import qr, solve_discrete_are, solve_triangular

from ..model.second_order import StateSpace
from .data import IdentificationError, Record
from .simulate import InnovationModel

Array = NDArray[np.float64]


@dataclass(frozen=True)
class ObserverMarkov:
    """y(k) = D v(k) + sum_i [b(i) a(i)] [v(k-i) y(k-i)] + e: Markov parameters of a predictor.

    `blocks` (s, m, p + m) for i = 1..s, D (m, p), `e_covariance` (m, m), from `rows` rows.
    """

    blocks: Array
    D: Array
    e_covariance: Array
    rows: int

    @property
    def akaike(self) -> float:
        """Akaike's criterion a row: log det of the error plus twice the parameters."""
        parameters = self.blocks.size + self.D.size
        return float(np.linalg.slogdet(self.e_covariance)[1] + 2.0 * parameters / self.rows)


@dataclass(frozen=True)
class StateSequence:
    """States estimated from the records: (x, v, y) of each, k columns of x.

    `singular_values` (k,) say how much of the future each state holds, descending.
    """

    records: tuple[tuple[Array, Array, Array], ...]
    singular_values: Array


def observer_markov(records: Sequence[Record], past: int, skip: int) -> ObserverMarkov:
    """Fit the observer's Markov parameters (OKID; a high-order ARX) to all records by QR.

    Rows before `skip` >= past are left out, so that models of different `past` compare. Raises
    IdentificationError for fewer than two rows a parameter.
    """
    X = np.vstack([np.hstack([_past(r, past, skip), r.v[skip:]]) for r in records])
    Y = np.vstack([r.y[skip:] for r in records])
    if len(X) < 2 * X.shape[1]:
        raise IdentificationError(
            f"expected at least {2 * X.shape[1]} rows for an observer of {past} past samples, "
            f"found {len(X)}"
        )
    theta = _least_squares(X, Y)
    error = Y - X @ theta
    m, p = Y.shape[1], records[0].v.shape[1]
    blocks = theta[: past * (p + m)].reshape(past, p + m, m).transpose(0, 2, 1)
    return ObserverMarkov(blocks, theta[past * (p + m) :].T, error.T @ error / len(X), len(X))


def choose_past(records: Sequence[Record], candidates: Sequence[int]) -> ObserverMarkov:
    """Return the observer of the candidate length with the least Akaike criterion."""
    p, m = records[0].v.shape[1], records[0].y.shape[1]
    rows = sum(len(r.y) for r in records)
    possible = [s for s in candidates if 2 * (s * (p + m) + p) < rows - s * len(records)]
    if not possible:
        raise IdentificationError(f"expected longer records for a predictor, found {rows} rows")
    # All are judged on the same rows: the likelihoods of different rows do not compare.
    fits = [observer_markov(records, past, max(possible)) for past in possible]
    best = min(range(len(fits)), key=lambda n: fits[n].akaike)
    return observer_markov(records, possible[best], possible[best])


def state_sequence(
    observer: ObserverMarkov, records: Sequence[Record], count: int
) -> StateSequence:
    """Return the states that the past leaves for the future, by the SVD of H Z.

    H is the Hankel matrix of the observer's Markov parameters (zero beyond its length), Z the past
    inputs and outputs: data-weighted Ho-Kalman (PBSID; Chiuso, Automatica 2007). Weighting by the
    data keeps what coloured inputs never drove from deciding the states.
    """
    past, m, width = observer.blocks.shape
    H = np.zeros((past, m, past, width))
    for row in range(past):
        H[row, :, : past - row] = observer.blocks[row:].transpose(1, 0, 2)
    Z = [_past(r, past, past) for r in records]
    _, s, Vt = np.linalg.svd(H.reshape(past * m, -1) @ np.vstack(Z).T, full_matrices=False)
    count = min(count, len(s))
    x = np.split(Vt[:count].T * np.sqrt(s[:count]), np.cumsum([len(z) for z in Z])[:-1])
    parts = [(x_r, r.v[past:], r.y[past:]) for x_r, r in zip(x, records, strict=True)]
    return StateSequence(tuple(parts), s[:count])


def innovation_model(sequence: StateSequence, order: int, Ts_s: float) -> InnovationModel:
    """Fit A, B, C, D to the first `order` states and take K from the residuals' covariance.

    K solves the discrete Riccati equation, so the predictor is stable whatever the data. Raises
    IdentificationError when that has no solution or the order exceeds the states.
    """
    available = len(sequence.singular_values)
    if not 1 <= order <= available:
        raise IdentificationError(f"expected an order of 1 to {available}, found {order}")
    n = order
    X = np.vstack([np.hstack([x[:-1, :n], v[:-1]]) for x, v, _ in sequence.records])
    Y = np.vstack([np.hstack([x[1:, :n], y[:-1]]) for x, _, y in sequence.records])
    theta = _least_squares(X, Y)
    error = Y - X @ theta
    covariance = error.T @ error / len(error)
    A, B, C, D = theta[:n, :n].T, theta[n:, :n].T, theta[:n, n:].T, theta[n:, n:].T
    Q, S, R = covariance[:n, :n], covariance[:n, n:], covariance[n:, n:]
    # A trace of process noise in every direction keeps the Riccati equation solvable.
    Q = Q + 1e-12 * np.trace(Q) * np.eye(n)
    try:
        P = solve_discrete_are(A.T, C.T, Q, R, s=S)
    except (np.linalg.LinAlgError, ValueError) as cause:
        raise IdentificationError(f"no steady-state predictor of order {order}: {cause}") from None
    e_covariance = C @ P @ C.T + R
    K = np.asarray(np.linalg.solve(e_covariance, (A @ P @ C.T + S).T).T, dtype=np.float64)
    return InnovationModel(StateSpace(A, B, C, D, Ts_s), K, e_covariance)


def _past(record: Record, past: int, skip: int) -> Array:
    """Return rows [v(k-1) y(k-1) ... v(k-past) y(k-past)] for k = skip..N-1."""
    z = np.hstack([record.v, record.y])
    return np.hstack([z[skip - i : len(z) - i] for i in range(1, past + 1)])


def _least_squares(X: Array, Y: Array) -> Array:
    """Solve min ||X theta - Y|| by QR, columns scaled so that units do not matter."""
    scale = np.maximum(np.linalg.norm(X, axis=0), np.finfo(float).tiny)
    Q, R = qr(X / scale, mode="economic")
    diagonal = np.abs(np.diag(R))
    if diagonal.min() <= 1e-13 * diagonal.max():
        raise IdentificationError(
            "expected inputs and outputs that are independent, found some that follow from others"
        )
    return np.asarray(solve_triangular(R, Q.T @ Y) / scale[:, None])
