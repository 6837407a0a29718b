"""State space from Markov parameters by Ho and Kalman, eqs. (10) to (13), errata applied."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...model.second_order import StateSpace
from ..nonparametric.least_squares import BLOCK_ROWS
from ..records.record import IdentificationError, Record
from .hankel_operator import HankelOperator, HankelSvd, leading_svd

Array = NDArray[np.float64]

SINGULAR_VALUES = 24
"""How many singular values are computed: the figure's, and the candidates for the order."""
_ROUNDING = 1e-13
"""Singular values, over the largest, of which nothing but rounding is known."""


@dataclass(frozen=True)
class Scaling:
    """Units in which signals weigh alike: outputs (m,) and inputs (p,) are divided by these."""

    outputs: Array
    inputs: Array

    @classmethod
    def of(cls, records: Sequence[Record]) -> Scaling:
        """Return units in which every signal has rms 1 in the record that moves it most."""
        outputs = np.max([r.y.std(axis=0) for r in records], axis=0)
        inputs = np.max([r.v.std(axis=0) for r in records], axis=0)
        return cls(np.where(outputs > 0, outputs, 1.0), np.where(inputs > 0, inputs, 1.0))


@dataclass(frozen=True)
class Decomposition:
    """The SVD (12) of a Hankel matrix with what (13) further needs of it; k triplets are kept.

    `first_columns` (k, p) is U^T times the first block column of H, `shifted` (k, k) is U^T H' V
    with H' one block column further, `D` (m, p) is g(0). All in scaled units.
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
        """The highest order that the singular values reach: what is below rounding is no state."""
        return int(np.sum(self.singular_values > _ROUNDING * self.singular_values[0]))


@dataclass(frozen=True)
class OrderChoice:
    """The order and the ratio s(n) / s(n + 1) by which it stands out; `gaps` has it for every n."""

    order: int
    gap: float
    gaps: Array


def decompose(
    g: Array, Ts_s: float, scaling: Scaling, count: int = SINGULAR_VALUES
) -> Decomposition:
    """Decompose the largest Hankel matrix (10) that Markov parameters g (L, m, p) fill.

    For white excitation: all taps are then known alike. The matrix is an operator, never formed.
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

    What the inputs (N, p) of the records hardly drive is badly known, and its errors would swamp
    the plain Hankel matrix; weighted by the inputs they shrink to the size that the outputs saw.
    For white inputs this is `decompose`. The matrix is formed: for short Markov parameters.
    """
    scaled = g * (scaling.inputs / scaling.outputs[:, None])
    blocks = _blocks(g)
    H = HankelOperator(scaled[1:], blocks, blocks)
    root = _covariance_root([u / scaling.inputs for u in inputs], blocks)
    U, s, Vt = np.linalg.svd(H.dense() @ root, full_matrices=False)
    count = min(count, len(s))
    svd = HankelSvd(U[:, :count], s[:count], Vt[:count])
    return _decomposition(scaled, H, svd, root @ svd.Vt.T, scaling, Ts_s)


def order_from_gap(singular_values: Array, least: int = 1) -> OrderChoice:
    """Return the order of at least `least` with the largest s(n) / s(n + 1).

    What is below rounding counts as equal.
    """
    s = np.maximum(singular_values, _ROUNDING * singular_values[0])
    gaps = s[:-1] / s[1:]
    first = min(least, len(gaps)) - 1
    order = first + int(np.argmax(gaps[first:])) + 1
    return OrderChoice(order, float(gaps[order - 1]), gaps)


def realise(decomposition: Decomposition, order: int) -> StateSpace:
    """Return the model (11) of `order` states by (13).

    A = S^-1/2 U^T H' V S^-1/2 with H' one block column further, B the first p columns of S^1/2 V^T
    (as S^-1/2 U^T H, the same), C the first m rows of U S^1/2, D = g(0). Raises IdentificationError
    for an order that the singular values do not reach.
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
    # g(0) is D and stays outside; one block is left for the shifted matrix of (13).
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
