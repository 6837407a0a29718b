"""Identify an innovation model from input and output: OKID, weighted SVD, Riccati equation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_discrete_are, solve_triangular

from ...model.second_order import StateSpace
from ..nonparametric.block_qr import BLOCK_ROWS, independent, triangle
from ..records.record import IdentificationError, Record
from .simulation import InnovationModel

Array = NDArray[np.float64]

ROUNDING = 1e-7
"""Relative size of regularisation rows: noise of 1e-7 of each signal.

They make data without noise solvable (PBSID adds as much to its Gram matrices).
"""


@dataclass(frozen=True)
class ObserverMarkov:
    """y(k) = D v(k) + sum_i [b(i) a(i)] [v(k-i) y(k-i)] + e: Markov parameters of a predictor.

    `blocks` (s, m, p + m) for i = 1..s, D (m, p); D is zero for records without a direct term.
    """

    blocks: Array
    D: Array


@dataclass(frozen=True)
class StateSequence:
    """States estimated from the records, sorted by their share in the prediction.

    `singular_values` (k,) measure that share, descending. `triangle` is the R of the QR of
    [v(k) x(k) | x(k+1) y(k)] over all `rows` rows with `inputs` inputs; every model is fitted from
    it. direct: whether y(k) may depend on v(k).
    """

    singular_values: Array
    triangle: Array
    rows: int
    inputs: int
    direct: bool = True


def choose_past(records: Sequence[Record], candidates: Sequence[int]) -> ObserverMarkov:
    """Estimate the observer (OKID, a high-order ARX model) with the least Akaike criterion.

    The criterion is log det of the error covariance plus twice the number of parameters per row.
    All candidate pasts use the same rows, so that their likelihoods are comparable, and follow from
    one QR; records shorter than the longest past are not used. Raises IdentificationError for fewer
    than two rows per parameter.
    """
    p, m = records[0].v.shape[1], records[0].y.shape[1]
    first = p if _direct(records) else 0
    possible = [s for s in candidates if 2 * (s * (p + m) + first) < _rows_with(records, s)]
    if not possible:
        total = sum(len(r.y) for r in records)
        raise IdentificationError(
            f"expected longer records for a predictor, found {total} rows in all"
        )
    longest = max(possible)
    R = _observer_triangle(records, longest)
    rows = _rows_with(records, longest)

    def akaike(past: int) -> float:
        columns = first + past * (p + m)
        error = R[columns:, -m:]
        size = np.linalg.slogdet(error.T @ error / rows)[1]
        return float(size + 2.0 * m * columns / rows)

    past = min(possible, key=akaike)
    if past < longest:
        R = _observer_triangle(records, past)
    theta = _solve(R, first + past * (p + m), m)
    blocks = theta[first:].reshape(past, p + m, m).transpose(0, 2, 1)
    return ObserverMarkov(blocks, theta[:first].T if first else np.zeros((m, p)))


def state_sequence(
    observer: ObserverMarkov, records: Sequence[Record], count: int
) -> StateSequence:
    """Estimate the states by the SVD of H Z.

    H is the Hankel matrix of the observer's Markov parameters (zero beyond its length), Z the past
    inputs and outputs: data-weighted Ho-Kalman (PBSID; Chiuso, Automatica 2007). The weight keeps
    directions that coloured inputs do not excite out of the states.
    """
    past, m, width = observer.blocks.shape
    inputs = width - m
    H = np.zeros((past, m, past, width))
    for row in range(past):
        H[row, :, : past - row] = observer.blocks[row:].transpose(1, 0, 2)
    flat = H.reshape(past * m, -1)
    blocks = [(r, k) for r in records for k in _blocks(past, len(r.y))]
    Z = (_past(r, past, k) for r, k in blocks)
    # H Z = H R^T Q^T: H R^T has the same singular values and left vectors.
    U, s, _ = np.linalg.svd(flat @ triangle(Z).T, full_matrices=False)
    count = int(min(count, np.sum(s > np.finfo(float).eps * s[0])))
    states = flat.T @ (U[:, :count] / np.sqrt(s[:count]))
    steps = [(r, k) for r in records for k in _blocks(past, len(r.y) - 1)]

    def step(record: Record, k: slice) -> Array:
        x = _past(record, past, slice(k.start, k.stop + 1)) @ states
        return np.hstack([record.v[k], x[:-1], x[1:], record.y[k]])

    R = _rounded(triangle(step(r, k) for r, k in steps))
    rows = sum(k.stop - k.start for _, k in steps)
    return StateSequence(s[:count], R, rows, inputs, _direct(records))


def innovation_model(sequence: StateSequence, order: int, Ts_s: float) -> InnovationModel:
    """Fit A, B, C, D to the first `order` states, and compute K from the residual covariance.

    K solves the discrete Riccati equation, so the predictor is always stable. Raises
    IdentificationError if the equation has no solution or the order exceeds the states.
    """
    available = len(sequence.singular_values)
    if not 1 <= order <= available:
        raise IdentificationError(f"expected an order of 1 to {available}, found {order}")
    n, p = order, sequence.inputs
    # Columns: v, the first n states | the same states one step later, the outputs.
    chosen = [*range(p + n), *range(p + available, p + available + n)]
    chosen += range(p + 2 * available, sequence.triangle.shape[1])
    R = sequence.triangle[:, chosen]
    theta = _solve(R[: p + n], p + n, R.shape[1] - p - n)
    error = R[p + n :, p + n :]
    A, B, C, D = theta[p:, :n].T, theta[:p, :n].T, theta[p:, n:].T, theta[:p, n:].T
    if not sequence.direct:
        R = triangle([R[:, [*range(p, p + n), *range(p), *range(p + n, R.shape[1])]]])
        C, D = _solve(R[:n], n, R.shape[1] - p - 2 * n).T, np.zeros_like(D)
        error = R[n:, p + n :].copy()
        error[:p, :n] = 0.0  # of the states, the inputs explain these rows
    covariance = error.T @ error / sequence.rows
    Q, S, R = covariance[:n, :n], covariance[:n, n:], covariance[n:, n:]
    # A trace of process noise in every direction keeps the Riccati equation solvable.
    Q = Q + 1e-12 * np.trace(Q) * np.eye(n)
    try:
        P = solve_discrete_are(A.T, C.T, Q, R, s=S)
    except (np.linalg.LinAlgError, ValueError) as cause:
        raise IdentificationError(
            f"order {order}: no steady-state predictor exists ({cause}); choose another order"
        ) from None
    e_covariance = C @ P @ C.T + R
    K = np.asarray(np.linalg.solve(e_covariance, (A @ P @ C.T + S).T).T, dtype=np.float64)
    return InnovationModel(StateSpace(A, B, C, D, Ts_s), K, e_covariance)


def _direct(records: Sequence[Record]) -> bool:
    return all(r.direct for r in records)


def _rows_with(records: Sequence[Record], past: int) -> int:
    """Return the number of rows, over all records, with at least `past` rows before them."""
    return sum(max(len(r.y) - past, 0) for r in records)


def _blocks(first: int, last: int) -> list[slice]:
    """Return rows first to last - 1 in blocks, to save memory."""
    return [slice(k, min(k + BLOCK_ROWS, last)) for k in range(first, last, BLOCK_ROWS)]


def _past(record: Record, past: int, k: slice) -> Array:
    """Return [v(k-1) y(k-1) ... v(k-past) y(k-past)] for rows k."""
    z = np.hstack([record.v[k.start - past : k.stop], record.y[k.start - past : k.stop]])
    return np.hstack([z[past - i : len(z) - i] for i in range(1, past + 1)])


def _observer_triangle(records: Sequence[Record], past: int) -> Array:
    """Return R of the QR of [v(k) z(k-1) ... z(k-past) | y(k)], recent samples first.

    v(k) is left out for records without a direct term.
    """
    blocks = ((r, k) for r in records for k in _blocks(past, len(r.y)))
    direct = _direct(records)
    R = triangle(
        np.hstack([*([r.v[k]] if direct else []), _past(r, past, k), r.y[k]]) for r, k in blocks
    )
    p = records[0].v.shape[1]
    # Dependent outputs (no noise) are regularised; dependent inputs are an error.
    if not independent(R[:p, :p], 1e-13):
        raise _not_independent("inputs")
    return _rounded(R)


def _rounded(R: Array) -> Array:
    return triangle([np.vstack([R, np.diag(ROUNDING * np.linalg.norm(R, axis=0))])])


def _solve(R: Array, columns: int, targets: int) -> Array:
    """Solve the least squares of the last `targets` columns of R on the first `columns`.

    Returns (columns, targets). Raises IdentificationError if the first columns are dependent.
    """
    square = R[:columns, :columns]
    if not independent(square, 1e-13):
        raise _not_independent("inputs and outputs")
    return np.asarray(solve_triangular(square, R[:columns, R.shape[1] - targets :]))


def _not_independent(what: str) -> IdentificationError:
    return IdentificationError(
        f"expected linearly independent {what}, found some that depend on others"
    )
