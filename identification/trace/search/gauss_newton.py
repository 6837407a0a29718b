"""Refine a working point by Gauss-Newton steps on linearised records."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from ....model.declared_model import ModelError
from ....model.effects.base import Effect, Quantity
from ...records.record import IdentificationError
from ...rounding import DIFFERENCE, ROUNDING
from ..linearised.gram_matrices import Linearised
from ..linearised.linearisation_point import WorkingPoint
from ..search_options import SearchOptions
from .damping import MOST_DAMPING, less, more
from .regression import ColumnEvidence, solve

Array = NDArray[np.float64]
IntArray = NDArray[np.intp]
Candidate = tuple[Effect, tuple[float, ...]]

_WORTH_A_STEP = SearchOptions.least_gain
"""Squared errors that a step must promise, and take: a step of s standard errors takes s^2."""
ROUGHLY, NEARLY, FULLY = (
    SearchOptions().negligible,
    SearchOptions.accuracy**2,
    DIFFERENCE,
)
"""The same as a share of how far the squares are from those of noise: while others are missing, or
the noise is assumed larger than it is, what is at its best now will not be then."""
NOISE = 1.0
"""Squared errors that the noise of one number takes: of a step that promises less, shorter ones are
not tried."""
_CRAWLS = SearchOptions.least_gain
"""Of what a step must promise: two in a row that take less crawl along a valley that bends."""
_LEASH = 1.0 / SearchOptions.resolved
"""Part of its range by half of which a shape may step; if it is a logarithm, half of its size."""
_SHORT = 1.0
"""Damping from which on a step is short."""


class Part(NamedTuple):
    """Blocks first to last (exclusive) of a training record."""

    record: int
    first: int
    last: int


class Fitted(Protocol):
    """Training records that can be linearised around a working point."""

    def train(
        self,
        point: WorkingPoint,
        candidates: Sequence[Candidate] = (),
        only: Sequence[Part] | None = None,
    ) -> list[Linearised]:
        """Return the training records linearised, all or parts of them."""


def refine(point: WorkingPoint, records: Fitted, within: float = 0.0) -> tuple[WorkingPoint, float]:
    """Refine a point to the nearest local minimum; return it and its squared errors.

    It ends where a whole step promises less than the share `within` of how far the squares are from
    those of noise; where two in a row take a tenth of that; and where errors rise along a short one
    by more than a whole one promises: trajectories move too, and have another gradient.
    """
    train = gather(point, records.train(point))
    damping, crawls, failed = 0.0, False, False
    for _ in range(SearchOptions.steps):
        step = least_squares_step(point, train)
        worth = max(_WORTH_A_STEP, within * abs(train.excess))
        promised = _promised(train, step)
        if promised < worth:
            break
        moved = stepped(point, least_squares_step(point, train, damping) if damping else step)
        try:
            after = gather(moved, records.train(moved))
        except (ModelError, IdentificationError, np.linalg.LinAlgError):
            after = None
        chance = max(ROUNDING * _cost(train), NOISE if promised < NOISE else 0.0)
        if after is not None and _cost(after) < _cost(train) + chance:
            gained = _cost(train) - _cost(after)
            point, train, damping, failed = moved, after, less(damping, failed), False
            crawled, crawls = crawls, gained < _CRAWLS * worth
            if gained < _WORTH_A_STEP or (crawled and crawls):
                break
        else:
            rises = after is not None and _cost(after) - _cost(train) > promised
            if promised < NOISE or damping >= (_SHORT if rises else MOST_DAMPING):
                break
            damping, failed = more(damping), True
    return point, train.squares


def gather(point: WorkingPoint, records: Sequence[Linearised]) -> ColumnEvidence:
    """Return the records' evidence, with the model file's priors on parameters.

    A parameter that records tell nothing of stays where it was declared: to know it worse than its
    worth is to know nothing of it.
    """
    p = point.parameters
    sd = np.minimum(p.worth, p.prior_sd)
    rows = np.zeros((len(sd), len(sd) + 1))
    np.fill_diagonal(rows, p.scale / sd)
    rows[:, -1] = (point.values - p.prior_mean) / sd
    return ColumnEvidence.gather(records, rows)


def least_squares_step(point: WorkingPoint, train: ColumnEvidence, damping: float = 0.0) -> Array:
    """Return the least-squares step in [parameters over scale, amplitudes, shapes].

    What stands at its bound and would leave it stays there, and the others move as that asks; so
    does what does nothing, as the shape of an effect of no size.
    """
    below, above = _room(point)
    damped = train.whole.copy()
    own = np.arange(len(below))
    damped[own, own] *= 1 + damping
    free: IntArray = np.flatnonzero(np.diag(train.whole)[:-1] > 0.0)
    while True:
        step = np.zeros(len(own))
        step[free] = solve(damped, free) / train.size[free]
        held = (step < 0.0) & (below <= 0.0) | (step > 0.0) & (above <= 0.0)
        if not held.any():
            return step
        free = free[~held[free]]


def _promised(train: ColumnEvidence, step: Array) -> float:
    """Return the predicted decrease of the squared errors, by the linear model."""
    scaled, whole = step * train.size[:-1], train.whole
    return -float(scaled @ (2.0 * whole[:-1, -1] + whole[:-1, :-1] @ scaled))


def _room(point: WorkingPoint) -> tuple[Array, Array]:
    """Return the distance of each parameter to its lower and upper bound, zero or less at it."""
    p = point.parameters
    below, above = [(point.values - p.low) / p.scale], [(p.high - point.values) / p.scale]
    for one in point.placed:
        quantities = (*one.effect.amplitudes, *one.effect.shape)
        values = np.array([*one.amplitudes, *one.shape])
        below.append(values - np.array([q.low for q in quantities]))
        above.append(np.array([q.high for q in quantities]) - values)
    return np.concatenate(below), np.concatenate(above)


def _cost(evidence: ColumnEvidence) -> float:
    return float(evidence.whole[-1, -1])


def stepped(point: WorkingPoint, step: Array) -> WorkingPoint:
    """Return the working point after a step in [parameters over scale, amplitudes, shapes].

    Nothing leaves its bounds.
    """
    p = point.parameters
    at, placed = len(p.names), []
    moved = np.clip(point.values + step[:at] * p.scale, p.low, p.high)
    values = dict(zip(p.names, moved.tolist(), strict=True))
    for one in point.placed:
        a, k = len(one.amplitudes), len(one.shape)
        moves = step[at + a : at + a + k]
        shape = [
            float(np.clip(value + leash(move, value, q), q.low, q.high))
            for value, move, q in zip(one.shape, moves, one.effect.shape, strict=True)
        ]
        amplitudes = [
            float(np.clip(value + move, q.low, q.high))
            for value, move, q in zip(
                one.amplitudes, step[at : at + a], one.effect.amplitudes, strict=True
            )
        ]
        placed.append(one.with_values(shape, amplitudes))
        at += a + k
    return replace(point, model=point.model.with_values(values), placed=tuple(placed))


def leash(move: float, value: float, quantity: Quantity) -> float:
    """Limit a step of a shape parameter to the range in which terms are nearly linear."""
    reach = 0.5 * (abs(value) if quantity.log else _LEASH * (quantity.high - quantity.low))
    return float(np.clip(move, -reach, reach))
