"""Realise a state-space model from Markov parameters by Ho-Kalman, eqs. (10) to (13) corrected."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import fft, signal

from ...model.second_order import StateSpace
from ..nonparametric.block_qr import BLOCK_ROWS
from ..nonparametric.markov_parameters import MarkovEstimate, convolve
from ..records.record import IdentificationError, Record
from .hankel_operator import HankelOperator, HankelSvd, largest_singular_value, leading_svd

Array = NDArray[np.float64]

SINGULAR_VALUES = 24
"""Number of singular values computed: plotted, and candidates for the order."""
_SEGMENT = 1024
"""Rows of a segment of the spectrum of what Markov parameters leave."""
_DRAWS, _SURE = 5, 4.0
"""Draws of the noise alone, and standard deviations of their largest singular value above them."""
_ROUNDING = 1e-13
"""Singular values below this share of the largest are rounding."""


@dataclass(frozen=True)
class Scaling:
    """Scales that give signals equal weight: outputs (m,) and inputs (p,) are divided by them."""

    outputs: Array
    inputs: Array

    @classmethod
    def of(cls, records: Sequence[Record]) -> Scaling:
        """Return scales with which every signal has rms 1 in the record that moves it most."""
        outputs = np.max([r.y.std(axis=0) for r in records], axis=0)
        inputs = np.max([r.v.std(axis=0) for r in records], axis=0)
        return cls(np.where(outputs > 0, outputs, 1.0), np.where(inputs > 0, inputs, 1.0))


@dataclass(frozen=True)
class Decomposition:
    """The truncated SVD (12) of a Hankel matrix, k triplets, and the other matrices of (13).

    `first_columns` (k, p) is U^T times the first block column of H; `shifted` (k, k) is U^T H' V
    with H' shifted by one block column; `D` (m, p) is g(0). All are in scaled units.
    """

    singular_values: Array
    first_rows: Array  # (m, k): of U
    first_columns: Array
    shifted: Array
    D: Array
    scaling: Scaling
    Ts_s: float

    @property
    def orders(self) -> int:
        """The highest possible order: the number of singular values above rounding."""
        return int(np.sum(self.singular_values > _ROUNDING * self.singular_values[0]))


def decompose(
    g: Array, Ts_s: float, scaling: Scaling, count: int = SINGULAR_VALUES
) -> Decomposition:
    """Decompose the largest Hankel matrix (10) of Markov parameters g (L, m, p).

    For white excitation, with which all taps are equally accurate. The matrix is an operator and
    is never formed.
    """
    scaled = g * (scaling.inputs / scaling.outputs[:, None])
    blocks = _blocks(g)
    H = HankelOperator(scaled[1:], blocks, blocks)
    svd = leading_svd(H, count)
    return _decomposition(scaled, H, svd, svd.Vt.T, scaling, Ts_s)


def decompose_coloured(
    g: Array, Ts_s: float, scaling: Scaling, inputs: Sequence[Array], count: int = SINGULAR_VALUES
) -> Decomposition:
    """Decompose H R^1/2 with R the covariance of the past inputs, for coloured excitation.

    Directions that the inputs (N, p) hardly excite have large errors, which would dominate the
    unweighted Hankel matrix; the weight scales them to their effect on the outputs. For white
    inputs this equals `decompose`. The matrix is formed: use it for short impulse responses.
    """
    scaled = g * (scaling.inputs / scaling.outputs[:, None])
    blocks = _blocks(g)
    H = HankelOperator(scaled[1:], blocks, blocks)
    root = _covariance_root([u / scaling.inputs for u in inputs], blocks)
    U, s, Vt = np.linalg.svd(H.dense() @ root, full_matrices=False)
    count = min(count, len(s))
    svd = HankelSvd(U[:, :count], s[:count], Vt[:count])
    return _decomposition(scaled, H, svd, root @ svd.Vt.T, scaling, Ts_s)


def noise_level(
    markov: MarkovEstimate,
    records: Sequence[Record],
    change: Callable[[Array], Array],
    scaling: Scaling,
) -> float:
    """Return the largest singular value that the errors of Markov parameters alone have.

    With white excitation the errors of taps are as coloured as what the parameters leave of the
    records. `change` returns what errors of Markov parameters do to those without delay and lag.
    """
    rng = np.random.default_rng(0)
    colour = np.sqrt(_colour(markov, records))[:, :, None]

    def drawn() -> float:
        white = fft.rfft(rng.normal(size=markov.g.shape), axis=0)
        error = markov.standard_error * fft.irfft(white * colour, len(markov.g), axis=0)
        error = change(error)
        # Single precision: a level within 1 % is enough, and takes half the time.
        scaled = (error * (scaling.inputs / scaling.outputs[:, None])).astype(np.float32)
        blocks = _blocks(error)
        return largest_singular_value(HankelOperator(scaled[1:], blocks, blocks))

    return level_of_chance(drawn)


def _colour(markov: MarkovEstimate, records: Sequence[Record]) -> Array:
    """Return the spectrum (L // 2 + 1, m) of what Markov parameters leave, of mean 1."""
    length = len(markov.g)
    bins = np.linspace(0.0, 0.5, length // 2 + 1)
    total = np.zeros((len(bins), markov.g.shape[1]))
    for record in records:
        left = (record.y - convolve(record.v, markov.g))[record.first_row(length) :]
        f, power = signal.welch(left, nperseg=min(_SEGMENT, len(left)), axis=0)
        total += np.array([np.interp(bins, f, column) for column in power.T]).T * len(left)
    return np.asarray(total / np.maximum(total.mean(axis=0), 1e-300))


def level_of_chance(drawn: Callable[[], float]) -> float:
    """Return the largest singular value that noise alone may have, from draws of it."""
    values = [drawn() for _ in range(_DRAWS)]
    return float(np.mean(values) + _SURE * np.std(values, ddof=1))


def realise(decomposition: Decomposition, order: int) -> StateSpace:
    """Return the model (11) of `order` states by (13).

    A = S^-1/2 U^T H' V S^-1/2 with H' shifted by one block column, B the first p columns of
    S^1/2 V^T (computed as S^-1/2 U^T H), C the first m rows of U S^1/2, D = g(0). Raises
    IdentificationError for an order above `Decomposition.orders`.
    """
    s, available = decomposition.singular_values, decomposition.orders
    if not 1 <= order <= available:
        raise IdentificationError(f"expected an order of 1 to {available}, found {order}")
    root = np.sqrt(s[:order])
    inputs, outputs = decomposition.scaling.inputs, decomposition.scaling.outputs[:, None]
    return StateSpace(
        decomposition.shifted[:order, :order] / root[:, None] / root,
        decomposition.first_columns[:order] / root[:, None] / inputs,
        decomposition.first_rows[:, :order] * root * outputs,
        decomposition.D / inputs * outputs,
        decomposition.Ts_s,
    )


def _blocks(g: Array) -> int:
    # g(0) is D and not in H; the shifted matrix of (13) needs one more block.
    blocks = (len(g) - 1) // 2
    if blocks < 1:
        raise IdentificationError(f"expected at least 3 Markov parameters, found {len(g)}")
    return blocks


def _decomposition(
    g: Array, H: HankelOperator, svd: HankelSvd, V: Array, scaling: Scaling, Ts_s: float
) -> Decomposition:
    shifted = HankelOperator(g[2:], H.block_rows, H.block_columns)
    first = g[1 : H.block_rows + 1].reshape(-1, g.shape[2])
    return Decomposition(
        svd.s,
        svd.U[: g.shape[1]],
        svd.U.T @ first,
        svd.U.T @ shifted.matmat(np.ascontiguousarray(V)),
        g[0],
        scaling,
        Ts_s,
    )


def _covariance_root(inputs: Sequence[Array], blocks: int) -> Array:
    """Return a square root of the covariance of [u(k-1), ..., u(k-blocks)]."""
    p = inputs[0].shape[1]
    total, count = np.zeros((blocks * p, blocks * p)), 0
    for u in inputs:
        for first in range(blocks - 1, len(u), BLOCK_ROWS):
            last = min(first + BLOCK_ROWS, len(u))
            past = np.hstack([u[first - b : last - b] for b in range(blocks)])
            total += past.T @ past
            count += len(past)
    values, vectors = np.linalg.eigh(total / count)
    return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0)))
