"""Regress prediction errors on columns from Gram matrices, with four-fold cross-validation.

The unit of the cross-validation is a time block: coefficients are fitted to three quarters of the
blocks and tested on the fourth.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...rounding import RIDGE, TINY
from ..linearised.gram_matrices import Beside, Linearised
from ..search_options import SearchOptions

Array = NDArray[np.float64]
Indices = Sequence[int] | NDArray[np.intp]

FOLDS = SearchOptions.resolved
_HELD = 1.0 / SearchOptions.accuracy


@dataclass(frozen=True)
class ColumnEvidence:
    """Blocks of several records: gram (blocks, Q, Q) with errors last, count as of Linearised.

    Columns are in units of `size` (Q,), common to all records. `beside`: candidates, each by
    itself.
    """

    gram: Array
    count: Array
    size: Array
    time_s: Array
    record: NDArray[np.int64]
    prior: Array
    beside: tuple[Beside, ...] = ()

    @classmethod
    def gather(cls, records: Sequence[Linearised], prior_rows: Array) -> ColumnEvidence:
        """Return the blocks of all records, columns with equal scales.

        `prior_rows` (., F + 1): what is known beforehand of the first F columns, errors last. It
        stands beside the records in every fit, and is no block.
        """
        sizes = np.array([r.size for r in records])
        size = np.sqrt(np.mean(sizes**2, axis=0))
        grams = [r.gram * np.outer(r.size / size, r.size / size) for r in records]
        rows = np.zeros((len(prior_rows), len(size)))
        known = prior_rows.shape[1] - 1
        rows[:, :known], rows[:, -1] = prior_rows[:, :-1], prior_rows[:, -1]
        rows /= size
        return cls(
            np.concatenate(grams),
            np.concatenate([r.count for r in records]),
            size,
            np.concatenate([r.time_s for r in records]),
            np.concatenate([np.full(len(r.gram), i) for i, r in enumerate(records)]),
            rows.T @ rows,
            tuple(_gathered(records, size, i) for i in range(len(records[0].beside))),
        )

    def joined(self, candidate: int) -> ColumnEvidence:
        """Insert a candidate's columns before the errors."""
        b = self.beside[candidate]
        own, width = len(self.size) - 1, len(b.size)
        order = np.append(np.delete(np.arange(own + 1 + width), own), own)
        gram = np.zeros((self.blocks, own + 1 + width, own + 1 + width))
        gram[:, : own + 1, : own + 1] = self.gram
        gram[:, : own + 1, own + 1 :] = b.cross
        gram[:, own + 1 :, : own + 1] = np.swapaxes(b.cross, 1, 2)
        gram[:, own + 1 :, own + 1 :] = b.inner
        prior = np.zeros(gram.shape[1:])
        prior[: own + 1, : own + 1] = self.prior
        return replace(
            self,
            gram=gram[:, order][:, :, order],
            size=np.concatenate([self.size, b.size])[order],
            prior=prior[np.ix_(order, order)],
            beside=(),
        )

    @cached_property
    def whole(self) -> Array:
        """Sum of all blocks' Gram matrices and of the prior's (Q, Q)."""
        return np.asarray(self.gram.sum(axis=0) + self.prior)

    @cached_property
    def folds(self) -> Array:
        """Sums of the Gram matrices that each fold leaves out (FOLDS, Q, Q)."""
        each = np.arange(self.blocks) % FOLDS
        return np.array([self.gram[each == fold].sum(axis=0) for fold in range(FOLDS)])

    @property
    def blocks(self) -> int:
        """Number of blocks."""
        return len(self.gram)

    @property
    def squares(self) -> float:
        """Sum of squared errors."""
        return float(self.gram[:, -1, -1].sum())

    @property
    def excess(self) -> float:
        """Sum of squared errors above noise."""
        return self.squares - float(self.count.sum())


def _scale(gram: Array) -> Array:
    """Return the roots of the diagonal, 1 for zero columns."""
    diagonal = np.diag(gram)
    return np.asarray(np.sqrt(np.where(diagonal > 0.0, diagonal, 1.0)))


def _gathered(records: Sequence[Linearised], size: Array, i: int) -> Beside:
    """Return candidate `i` of all records, with equal scales."""
    parts = [r.beside[i] for r in records]
    own = np.sqrt(np.mean([p.size**2 for p in parts], axis=0))
    cross = [
        p.cross * ((r.size / size)[:, None] * (p.size / own))
        for r, p in zip(records, parts, strict=True)
    ]
    inner = [p.inner * np.outer(p.size / own, p.size / own) for p in parts]
    return Beside(np.concatenate(cross), np.concatenate(inner), own)


def solve(gram: Array, columns: Indices) -> Array:
    """Return the least-squares coefficients of columns; gram (Q, Q), errors last."""
    pick = np.asarray(columns, int)
    A = gram[np.ix_(pick, pick)]
    b = gram[pick, -1]
    scale = _scale(A)
    scaled = A / scale[:, None] / scale + RIDGE * np.eye(len(pick))
    return np.asarray(-np.linalg.solve(scaled, b / scale) / scale)


def covariance(gram: Array, columns: Indices) -> Array:
    """Return the covariance of those coefficients for errors of unit variance."""
    pick = np.asarray(columns, int)
    A = gram[np.ix_(pick, pick)]
    scale = _scale(A)
    scaled = A / scale[:, None] / scale + RIDGE * np.eye(len(pick))
    return np.asarray(np.linalg.inv(scaled) / scale[:, None] / scale)


def remaining(gram: Array, columns: Indices, coefficients: Array) -> Array:
    """Return the squared residuals (blocks,) for given coefficients; gram (blocks, Q, Q)."""
    pick = np.asarray(columns, int)
    inner = gram[:, pick][:, :, pick]
    return np.asarray(
        gram[:, -1, -1]
        + 2 * gram[:, pick, -1] @ coefficients
        + np.einsum("i,bij,j->b", coefficients, inner, coefficients, optimize=True)
    )


def cross_validated(evidence: ColumnEvidence, columns: Indices) -> Array:
    """Return the cross-validated squared residuals (blocks,) of the columns."""
    pick = np.append(np.asarray(columns, int), -1)
    few = np.arange(len(pick) - 1)
    by_fold = evidence.folds[:, pick][:, :, pick]
    whole = evidence.whole[np.ix_(pick, pick)]
    grams = evidence.gram[:, pick][:, :, pick]
    left = np.empty(evidence.blocks)
    each = np.arange(evidence.blocks) % FOLDS
    for fold in range(FOLDS):
        out = each == fold
        left[out] = remaining(grams[out], few, solve(whole - by_fold[fold], few))
    return left


def steadied(evidence: ColumnEvidence) -> ColumnEvidence:
    """Regularise the columns to about a hundred of their standard errors.

    The moment at which something came is told by one block alone; a fit without that block would
    put it anywhere, and every question about anything else would be answered by that.
    """
    own = np.arange(len(evidence.size) - 1)
    variance = np.diag(covariance(evidence.whole, own))
    prior = evidence.prior.copy()
    prior[own, own] += 1.0 / (_HELD**2 * np.maximum(variance, TINY))
    return replace(evidence, prior=prior)


def gains(evidence: ColumnEvidence) -> list[Array]:
    """Return by how much each candidate lowers the cross-validated squared errors (blocks,)."""
    return gains_beside(steadied(evidence))


def gains_beside(evidence: ColumnEvidence) -> list[Array]:
    """Return the same for evidence that is regularised already."""
    before = cross_validated(evidence, range(len(evidence.size) - 1))
    found = []
    for i in range(len(evidence.beside)):
        joined = evidence.joined(i)
        found.append(before - cross_validated(joined, range(len(joined.size) - 1)))
    return found


def standard_errors(evidence: ColumnEvidence, columns: Indices) -> Array:
    """Return the standard errors (P,) of coefficients at the least squares, over no `size`.

    What is left need be neither white nor of one size everywhere: blocks of time stand for
    themselves, in the sandwich H^-1 (sum of g g^T over blocks) H^-1 of their gradients g (Liang and
    Zeger, Biometrika 73 (1986) 13), times B / (B - P) for P coefficients. An equation that is not
    exact is wrong in one way in a whole record, and in another way in the next: so records stand
    for themselves too, times R / (R - 1). The largest counts, and at least what errors of one size
    would give, and noise of unit variance.
    """
    pick = np.asarray(columns, int)
    spread = covariance(evidence.whole, pick)
    common = max(evidence.squares / max(float(evidence.count.sum()), 1.0), 1.0) * np.diag(spread)
    gradients = evidence.gram[:, pick, -1] @ spread
    spare = evidence.blocks - len(pick)
    own = (gradients**2).sum(axis=0) * evidence.blocks / spare if spare > 0 else common
    records = np.unique(evidence.record)
    by_record = np.array([gradients[evidence.record == r].sum(axis=0) for r in records])
    few = (by_record**2).sum(axis=0) * len(records) / max(len(records) - 1, 1)
    largest = np.max([common, own, few if len(records) > 1 else common], axis=0)
    return np.asarray(np.sqrt(largest) / evidence.size[pick])


class Foretold(NamedTuple):
    """What a prediction of errors says, over the standard deviation of chance.

    statistic: its agreement with the errors; a standard normal number if it predicts nothing.
    expected: what that is for a right prediction. One that agrees by more than half of it lowers
    the squared errors.
    """

    statistic: float
    expected: float


def foretold(
    evidence: ColumnEvidence, base: Indices, group: Indices, coefficients: Array
) -> Foretold:
    """Return how a prediction agrees with these errors, in standard deviations of chance.

    `coefficients` of [base, group] come from other records. What the group predicts, freed of what
    the base could do as well here, is correlated with the errors. Errors larger than noise make
    chance larger: each block's by its own, and all by how much what blocks say scatters.
    """
    b = np.asarray(coefficients)[len(list(base)) :]
    return _beyond(_agreement(evidence.gram, base, group, b), evidence.count)


def foretold_between(evidence: ColumnEvidence, base: Indices, group: Indices) -> Foretold:
    """Return `foretold` by cross-validation: each fold is predicted from the others.

    Two folds predict each other, so that noise alone gives twice the variance.
    """
    evidence = steadied(evidence)
    columns, own = [*base, *group], len(list(base))
    each = np.arange(evidence.blocks) % FOLDS
    parts, counts = [], []
    for fold, summed in enumerate(evidence.folds):
        b = solve(evidence.whole - summed, columns)[own:]
        parts.append(_agreement(evidence.gram[each == fold], base, group, b))
        counts.append(evidence.count[each == fold])
    together = _Agreement(*(np.concatenate(part) for part in zip(*parts, strict=True)))
    return _beyond(together, np.concatenate(counts))


class _Agreement(NamedTuple):
    """Per block: prediction times errors, squared prediction, and squared residual."""

    with_errors: Array
    predicted: Array
    left: Array


def _agreement(grams: Array, base: Indices, group: Indices, b: Array) -> _Agreement:
    """Return the agreement of the prediction by `b`, with the base columns projected out."""
    base_list, group_list = list(base), list(group)
    pick = np.array([*base_list, *group_list, grams.shape[1] - 1])
    few = grams[:, pick][:, :, pick]
    own, gram = len(base_list), few.sum(axis=0)
    A = gram[:own, :own]
    scale = _scale(A)
    inverse = np.linalg.inv(A / scale[:, None] / scale + RIDGE * np.eye(own))
    inverse = inverse / scale[:, None] / scale
    prediction = np.concatenate([-inverse @ (gram[:own, own:-1] @ b), b, [0.0]])
    errors = np.concatenate([-inverse @ gram[:own, -1], np.zeros(len(b)), [1.0]])
    after = errors + prediction

    def of(one: Array, other: Array) -> Array:
        return np.asarray(np.einsum("i,kij,j->k", one, few, other, optimize=True))

    return _Agreement(
        -of(prediction, errors), np.maximum(of(prediction, prediction), 0.0), of(after, after)
    )


def _beyond(agreement: _Agreement, count: Array) -> Foretold:
    """Return the sums of with_errors and of predicted over the standard deviation of chance.

    The larger of two: errors that are white in a block, of its own mean square, but no less than
    noise; and blocks that have nothing to do with each other, whatever is in them.
    """
    with_errors, predicted, left = agreement
    whole, blocks = float(predicted.sum()), len(predicted)
    if whole <= 0.0:
        return Foretold(0.0, 0.0)
    white = float(predicted @ np.maximum(left / np.maximum(count, 1.0), 1.0))
    scatter = with_errors - predicted * (float(with_errors.sum()) / whole)
    apart = float(scatter @ scatter) * blocks / max(blocks - 1, 1)
    chance = np.sqrt(max(white, apart))
    return Foretold(float(with_errors.sum() / chance), whole / float(chance))
