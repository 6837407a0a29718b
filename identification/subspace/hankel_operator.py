"""The block Hankel matrix (10) as an operator by FFT, and its leading SVD (12)."""

from __future__ import annotations

from dataclasses import dataclass
from threading import Lock

import numpy as np
from numpy.typing import NDArray
from scipy import fft
from scipy.sparse.linalg import ArpackError, LinearOperator, svds
from threadpoolctl import threadpool_limits

Array = NDArray[np.float64]

_ONE_AT_A_TIME = Lock()
"""Neither PROPACK nor ARPACK says that calls in several threads are independent."""
DENSE_SIDE = 400
"""Up to this size the matrix is formed: a dense SVD is faster and gives all singular values."""


@dataclass(frozen=True)
class HankelSvd:
    """Leading singular triplets of H: U (nr m, k), s (k,) descending, Vt (k, nc p)."""

    U: Array
    s: Array
    Vt: Array


class HankelOperator(LinearOperator):
    """H with nr x nc blocks h(a + b), h of shape (L, m, p), L >= nr + nc - 1; never formed.

    It computes in the precision of h.
    """

    def __init__(self, h: NDArray[np.floating], block_rows: int, block_columns: int) -> None:
        length, self.m, self.p = h.shape
        if length < block_rows + block_columns - 1:
            raise ValueError(
                f"expected at least {block_rows + block_columns - 1} Markov parameters for "
                f"{block_rows} x {block_columns} blocks, found {length}"
            )
        self.block_rows, self.block_columns = block_rows, block_columns
        self._h = h[: block_rows + block_columns - 1]
        self._size = fft.next_fast_len(block_rows + block_columns - 1, real=True)
        self._spectrum = fft.rfft(self._h, self._size, axis=0).conj()
        shape = (block_rows * self.m, block_columns * self.p)
        super().__init__(h.dtype, shape)  # type: ignore[call-arg]

    def _matmat(self, X: Array) -> Array:
        x = X.reshape(self.block_columns, self.p, -1)
        return self._correlated("fij,fjc->fic", x, self.block_rows)

    def _rmatmat(self, X: Array) -> Array:
        x = X.reshape(self.block_rows, self.m, -1)
        return self._correlated("fji,fjc->fic", x, self.block_columns)

    def _matvec(self, x: Array) -> Array:
        return self._matmat(x.reshape(-1, 1)).ravel()

    def _rmatvec(self, x: Array) -> Array:
        return self._rmatmat(x.reshape(-1, 1)).ravel()

    def _correlated(self, product: str, x: Array, blocks: int) -> Array:
        # sum_b h(a + b) x(b) is a correlation: the conjugate spectrum gives it in reverse order.
        spectrum = np.einsum(product, self._spectrum, fft.rfft(x, self._size, axis=0))
        y = fft.irfft(spectrum, self._size, axis=0)[-np.arange(blocks) % self._size]
        return np.asarray(y.reshape(blocks * y.shape[1], -1))

    def dense(self) -> Array:
        """Return the explicit matrix; for small ones only."""
        index = np.arange(self.block_rows)[:, None] + np.arange(self.block_columns)
        return np.asarray(self._h[index].transpose(0, 2, 1, 3).reshape(self.shape))


def leading_svd(operator: HankelOperator, count: int) -> HankelSvd:
    """Return the `count` largest singular triplets; repeated calls give the same result.

    Small matrices use a dense SVD, others PROPACK's Lanczos bidiagonalisation, which is accurate
    for small singular values. If that fails, ARPACK on H^T H is used, which is inaccurate below
    1e-8 of the largest.
    """
    count = min(count, *operator.shape)
    if max(operator.shape) <= DENSE_SIDE:
        U, s, Vt = np.linalg.svd(operator.dense(), full_matrices=False)
        return HankelSvd(U[:, :count], s[:count], Vt[:count])
    start = np.random.default_rng(0).normal(size=operator.shape[0])
    # Lanczos vectors are long and few: several BLAS threads would only wait for each other.
    with _ONE_AT_A_TIME, threadpool_limits(1, "blas"):
        try:
            U, s, Vt = svds(operator, count, solver="propack", v0=start)
        except (np.linalg.LinAlgError, ArpackError):
            U, s, Vt = svds(operator, count, solver="arpack", v0=start[: min(operator.shape)])
    down = np.argsort(s)[::-1]
    return HankelSvd(U[:, down], np.asarray(s[down], dtype=np.float64), Vt[down])


def largest_singular_value(operator: HankelOperator, steps: int = 24) -> float:
    """Return the largest singular value by Golub and Kahan's bidiagonalisation.

    From below, within 1 % for noise, whose largest singular values lie close to each other: there
    iterations that wait for convergence take a hundred times longer.
    """
    steps = min(steps, *operator.shape)
    right = np.random.default_rng(0).normal(size=operator.shape[1]).astype(operator.dtype)
    V, U = (np.zeros((steps, size), operator.dtype) for size in operator.shape[::-1])
    bidiagonal = np.zeros((steps, steps))
    for k in range(steps):
        V[k] = right / np.linalg.norm(right)
        left = operator.matvec(V[k])
        left -= U[:k].T @ (U[:k] @ left)
        bidiagonal[k, k] = np.linalg.norm(left)
        if bidiagonal[k, k] == 0.0:
            break
        U[k] = left / bidiagonal[k, k]
        right = operator.rmatvec(U[k])
        right -= V[: k + 1].T @ (V[: k + 1] @ right)
        if k + 1 < steps:
            bidiagonal[k, k + 1] = np.linalg.norm(right)
            if bidiagonal[k, k + 1] == 0.0:
                break
    return float(np.linalg.svd(bidiagonal, compute_uv=False)[0])
