"""Judge columns by blocks of time that did not fit them: gain, standard error, and other records.

For each block of time the Gram matrix of [columns, missing force] is enough: a fit without the
block comes from the sum of the others, and the block's squared error from its own.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from ...rounding import RIDGE, ROUNDING, TINY

Array = NDArray[np.float64]

_FORETOLD = 2.0**2
"""Variances of chance that a record must be foretold to contradict: two standard deviations."""
_NOISE_DEVIATIONS = 2.0
"""An effect of size s gains s, with a standard deviation of 2 sqrt(s) by noise of unit variance."""


@dataclass(frozen=True)
class Blocks:
    """Rows of the records cut into blocks: edges of each record, and the record of each block."""

    edges: tuple[NDArray[np.int64], ...]
    record: NDArray[np.int64]

    @classmethod
    def of(cls, rows: Sequence[int], blocks: int) -> Blocks:
        """Return about `blocks` blocks of equal length, at least two in each record."""
        length = sum(rows) / blocks
        counts = [max(round(n / length), 2) for n in rows]
        edges = tuple(
            np.linspace(0, n, count + 1).astype(np.int64)
            for n, count in zip(rows, counts, strict=True)
        )
        return cls(edges, np.repeat(np.arange(len(rows)), counts))

    def grams(self, columns: Sequence[Array], missing: Sequence[Array]) -> Array:
        """Return the Gram matrix of each block and DOF (B, n, C + 1, C + 1).

        columns: of each record (C, rows, n); missing: of each record (rows, n).
        """
        found = []
        for edges, own, left in zip(self.edges, columns, missing, strict=True):
            whole = np.concatenate([own, left[None]])
            for first, last in pairwise(edges.tolist()):
                part = np.moveaxis(whole[:, first:last], 2, 0)
                found.append(part @ np.swapaxes(part, 1, 2))
        return np.array(found)

    def products(
        self, instruments: Sequence[Array], columns: Sequence[Array], missing: Sequence[Array]
    ) -> Array:
        """Return the products of instruments with [columns, missing force] (B, C, C + 1), summed
        over DOF; the first two are of each record (C, rows, n), the last (rows, n)."""
        found = []
        triples = zip(self.edges, instruments, columns, missing, strict=True)
        for edges, of_instruments, own, left in triples:
            whole = np.concatenate([own, left[None]])
            for first, last in pairwise(edges.tolist()):
                found.append(
                    np.tensordot(
                        of_instruments[:, first:last], whole[:, first:last], ([1, 2], [1, 2])
                    )
                )
        return np.array(found)


def block_sums(blocks: Blocks, values: Sequence[Array]) -> Array:
    """Return the sum of squares of values (rows, n) of each record in each block (B,)."""
    found = []
    for edges, own in zip(blocks.edges, values, strict=True):
        found += [float(np.sum(own[a:b] ** 2)) for a, b in pairwise(edges.tolist())]
    return np.array(found)


def fitted(gram: Array, prior: Array | None = None) -> Array:
    """Return the coefficients (..., C) of Gram matrices (..., C + 1, C + 1)."""
    A, b = gram[..., :-1, :-1], gram[..., :-1, -1]
    if prior is not None:
        A, b = A + prior[:-1, :-1], b + prior[:-1, -1]
    size = _sizes(A)
    scaled = A / size[..., :, None] / size[..., None, :]
    scaled = scaled + RIDGE * np.eye(A.shape[-1])
    return np.asarray(np.linalg.solve(scaled, (b / size)[..., None])[..., 0] / size)


def _sizes(A: Array) -> Array:
    """Return the norms of the columns (..., C), one for a column that is zero."""
    squares = np.diagonal(A, axis1=-2, axis2=-1)
    return np.asarray(np.sqrt(np.where(squares > 0.0, squares, 1.0)))


def squared_errors(gram: Array, coefficients: Array) -> Array:
    """Return the squared error of coefficients (..., C) in each Gram matrix."""
    Ab = np.einsum("...ij,...j->...i", gram[..., :-1, :-1], coefficients)
    cross = np.sum(gram[..., :-1, -1] * coefficients, axis=-1)
    return np.asarray(gram[..., -1, -1] - 2.0 * cross + np.sum(coefficients * Ab, axis=-1))


@dataclass(frozen=True)
class Columns:
    """A model's Gram matrices: what blocks say of its numbers, and how these change its forces.

    grams (B, n, C + 1, C + 1): of [columns, missing force] in each block, by DOF. power (n, C + 1,
    C + 1): of [change by each number of the forces that set the scale, these forces] over all
    blocks. prior (C + 1, C + 1): of the columns.
    """

    grams: Array
    power: Array
    prior: Array

    def coefficients(self) -> Array:
        """Return the coefficients (C,) of the fit to all blocks and DOF."""
        return fitted(self.grams.sum(axis=(0, 1)), self.prior)

    def left_out_errors(self) -> Array:
        """Return each block's squared error (B,) by the coefficients of all other blocks."""
        return np.asarray(self.left_out_errors_by_dof().sum(axis=1))

    def left_out_errors_by_dof(self) -> Array:
        """Return the same of each DOF (B, n).

        The error of each DOF counts more where the model's forces become smaller: a model in which
        all forces are small explains nothing.
        """
        together = self.grams.sum(axis=1)
        coefficients = fitted(together.sum(axis=0) - together, self.prior)
        errors = squared_errors(self.grams, coefficients[:, None])
        whole = np.column_stack([coefficients, np.ones(len(errors))])
        power = np.einsum("bi,nij,bj->bn", whole, self.power, whole)
        now = self.power[:, -1, -1]
        relative = now / np.maximum(power, ROUNDING * np.maximum(now, TINY))
        return np.asarray(errors * np.maximum(relative, 1.0))

    def over(self, inside: NDArray[np.bool_]) -> Array:
        """Return the Gram matrix (C + 1, C + 1) of some blocks, over all DOF."""
        return np.asarray(self.grams[inside].sum(axis=(0, 1)))

    def only(self, columns: Sequence[int]) -> Columns:
        """Return the columns with these numbers, in this order."""
        pick = [*columns, len(self.prior) - 1]
        rows, across = np.ix_(pick, pick)
        return Columns(
            self.grams[:, :, rows, across], self.power[:, rows, across], self.prior[rows, across]
        )


def error_of_mean(gains: Array, size: Array) -> float:
    """Return the standard error of the mean of gains (B,) by effects of a size (B,), squared.

    It is the scatter about gains in proportion to the size. What is expected of a block follows
    from the others: a large effect in one block and a small one in another scatter little if they
    agree, and one block alone tells nothing.
    """
    others = np.maximum(size.sum() - size, TINY)
    expected = size * (gains.sum() - gains) / others
    return float(np.linalg.norm(gains - expected)) / len(gains)


def bounded(gains: Array, size: Array) -> Array:
    """Return gains (B,), at most what an effect of the size (B,) may gain.

    A block without which the model itself is another one gains more than the effect does in it.
    """
    most = size + 2.0 * _NOISE_DEVIATIONS * np.sqrt(size)
    return np.clip(gains, -most, most)


@dataclass(frozen=True)
class Gain:
    """Squared errors that an effect takes of blocks that did not fit it (B,).

    raw (B,): the same without the bound by what the effect does in a block. share: part of the
    squared error without the effect that it takes, at the DOF where that is most: what another DOF
    lacks is no measure of it. size (B,): square of the change of the model's force in each block,
    with all blocks fitted. others: for each record, what the effect takes of it if only the other
    records fit it, nan where these do not determine it (halves, if there is one record).
    """

    blocks: Array
    raw: Array
    share: float
    size: Array
    others: Array

    @property
    def mean(self) -> float:
        """Mean per block."""
        return float(self.blocks.mean())

    @property
    def standard_error(self) -> float:
        """Standard error of the mean."""
        return error_of_mean(self.blocks, self.size)

    @property
    def statistic(self) -> float:
        """Mean over its standard error."""
        return float(self.mean / max(self.standard_error, TINY))

    @property
    def elsewhere(self) -> bool:
        """Whether no other record contradicts."""
        asked = self.others[np.isfinite(self.others)]
        return bool(np.all(asked > 0.0))


def gain_of(
    before: Columns,
    after: Columns,
    size: Array,
    base: int,
    amplitudes: int,
    record: NDArray[np.int64],
) -> Gain:
    """Return the gain of one model over another, by their Gram matrices of all blocks.

    size (B,): square of the difference of their missing forces in each block.

    The first `base` columns of `after` are the model's own, then follow those of the amplitudes of
    the effect that is judged, then of its shape, which is held where other records foretell one.
    """
    without_it = before.left_out_errors_by_dof()
    by_dof = without_it - after.left_out_errors_by_dof()
    taken, there = by_dof.sum(axis=0), without_it.sum(axis=0)
    share = float(np.max(taken / np.maximum(there, TINY)))
    raw = by_dof.sum(axis=1)
    blocks = np.minimum(raw, bounded(raw, size))
    groups = record if len(set(record.tolist())) > 1 else np.arange(len(record)) * 2 // len(record)
    few = after.only(range(base + amplitudes))
    kinds = np.unique(groups)
    others = np.full(len(kinds), np.nan)
    for i, kind in enumerate(kinds.tolist()):
        inside = groups == kind
        rest, own = few.over(~inside), few.over(inside)
        extra = fitted(rest, few.prior)[base:]
        if _foretold(rest, own, base, extra):
            # The model's own parameters are those of the record: only the effect is foreign.
            without = before.over(inside)
            at_home = squared_errors(without, fitted(without, before.prior))
            small = _with_fixed(own, base, extra)
            prior = _with_fixed(few.prior, base, 0.0 * extra)
            others[i] = at_home - squared_errors(small, fitted(small, prior))
    return Gain(blocks, raw, share, size, others)


def _with_fixed(gram: Array, base: int, extra: Array) -> Array:
    """Return the Gram matrix of [base columns, what is left of the last one by fixed others]."""
    take = np.zeros((len(gram), base + 1))
    take[:base, :base] = np.eye(base)
    take[base:-1, -1], take[-1, -1] = -extra, 1.0
    return np.asarray(take.T @ gram @ take)


def _foretold(rest: Array, own: Array, base: int, extra: Array) -> bool:
    """Return whether records foretell an effect in another one, which can tell whether it is there.

    So it is if the force that is expected there, beside the model's own columns, is larger than
    twice its uncertainty, and than twice what chance makes of it there, of unit variance: a record
    without a force near a limit says nothing of a saturation.
    """
    there, known = (_beside(gram[:-1, :-1], base) for gram in (own, rest))
    size = _sizes(known)
    inverse = np.linalg.inv(known / size[:, None] / size + RIDGE * np.eye(len(known)))
    uncertain = float(np.trace(there @ (inverse / size[:, None] / size)))
    return float(extra @ there @ extra) > _FORETOLD * (uncertain + 1.0)


def _beside(A: Array, base: int) -> Array:
    """Return the Gram matrix of the columns behind `base`, with those before projected out."""
    size = _sizes(A)
    scaled = A / size[:, None] / size
    inner = scaled[:base, :base] + RIDGE * np.eye(base)
    cross = scaled[:base, base:]
    left = scaled[base:, base:] - cross.T @ np.linalg.solve(inner, cross)
    return np.asarray(left * size[base:, None] * size[base:])
