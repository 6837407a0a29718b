"""Fit the shapes of many candidates at once, along the trajectories of the point they are added to.

The errors are linear in the parameters of the model and in a candidate's amplitudes, and nonlinear
in its shape only (separable least squares: Golub and Pereyra, SIAM J. Numer. Anal. 10 (1973) 413).
At each trial shape the linear numbers are regressed, and a Gauss-Newton step for the shape follows
from the columns of the shape's derivatives beside those of the amplitudes. Each amplitude has its
own derivatives, so that they are right for the amplitudes that the regression finds: the phase of a
line turns with its frequency. The columns of the model are those of the point, so that a step costs
the columns of the candidates alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from ....model.declared_model import ModelError
from ....model.effects.base import Effect, Placed, Signals, Term
from ...records.record import IdentificationError
from ..linearised.linearisation_point import WorkingPoint
from ..linearised.linearise_prediction_errors import effect_terms
from ..search_options import SearchOptions
from .backward_elimination import columns_of, without_effect
from .damping import MOST_DAMPING, less, more
from .gauss_newton import NOISE, ROUGHLY, Candidate, Fitted, gather, leash
from .regression import (
    ColumnEvidence,
    cross_validated,
    gains_beside,
    remaining,
    solve,
    steadied,
)
from .tested_candidate import Tried

Array = NDArray[np.float64]


def with_fitted_shapes(
    point: WorkingPoint,
    tried: Sequence[Tried],
    records: Fitted,
    instead_of: Placed | None = None,
) -> list[Tried]:
    """Return the candidates with fitted shapes and amplitudes, and their cross-validated gains.

    They start from their shapes; of those without shape the amplitudes are fitted. With
    `instead_of`, each is in the place of this effect of the point.
    """
    fits = [_Fit(t) for t in tried]
    for _ in range(SearchOptions.steps // 2 + 1):
        active = [fit for fit in fits if not fit.ended]
        if not active:
            break
        _step(point, active, records, instead_of)
    return [fit.best for fit in fits]


def _step(
    point: WorkingPoint, fits: Sequence[_Fit], records: Fitted, instead_of: Placed | None
) -> None:
    """Ask the records about the next shapes; one that cannot be computed ends its fit alone."""
    try:
        train = steadied(gather(point, records.train(point, [fit.asked() for fit in fits])))
    except (ModelError, IdentificationError, np.linalg.LinAlgError):
        if len(fits) == 1:
            fits[0].ended = True
            return
        for fit in fits:
            _step(point, [fit], records, instead_of)
        return
    if instead_of is not None:
        columns = columns_of(point, instead_of)
        train = without_effect(train, columns, instead_of.amplitudes)
    for i, fit in enumerate(fits):
        fit.told(train, i)


class _Fit:
    """One candidate's fit: the best shape so far, and the one that is tried next."""

    def __init__(self, tried: Tried) -> None:
        self.best, self.shape, self.ended, self._failed = tried, tried.shape, False, False
        self._squares, self._damping = np.inf, 0.0
        self._joined: _Joined | None = None

    def asked(self) -> Candidate:
        """Return the candidate at the shape to try, with the columns of the shape's derivatives."""
        return _tangent(self.best.effect), self.shape

    def told(self, train: ColumnEvidence, number: int) -> None:
        """Take what candidate `number` of the evidence says of the shape; find the next one."""
        there = _Joined.of(train, number, self.best.effect)
        if self._joined is None and not np.isfinite(there.squares):
            self.best, self.ended = replace(self.best, gain=-np.inf), True
            return
        if there.squares < self._squares:
            self.best = replace(
                self.best,
                shape=self.shape,
                amplitudes=there.amplitudes,
                blocks=there.gain,
                gain=float(there.gain.sum()),
            )
            self._squares, self._joined = there.squares, there
            self._damping, self._failed = less(self._damping, self._failed), False
        else:
            self._damping, self._failed = more(self._damping), True
        assert self._joined is not None
        move, promised = self._joined.step(self.best, self._damping)
        moved = tuple(
            float(np.clip(value + leash(one, value, q), q.low, q.high))
            for one, value, q in zip(move, self.best.shape, self.best.effect.shape, strict=True)
        )
        left = self._squares - float(train.count.sum())
        worth = max(NOISE, ROUGHLY * left)
        self.ended = promised < worth or self._damping > MOST_DAMPING or moved == self.best.shape
        self.shape = moved


@dataclass(frozen=True)
class _Joined:
    """What the blocks say at one shape of a candidate.

    gram (Q, Q): of all blocks, of [base, amplitudes, derivatives by the shape, errors], in units of
    size (Q,). gain (B,): what its amplitudes take of the cross-validated squared errors.
    amplitudes: regressed, within their bounds. squares: what is left with them.
    """

    gram: Array
    size: Array
    gain: Array
    squares: float
    amplitudes: tuple[float, ...]

    @classmethod
    def of(cls, train: ColumnEvidence, number: int, effect: Effect) -> _Joined:
        """Return it for candidate `number` of the evidence."""
        joined, own = train.joined(number), len(train.size) - 1
        count = len(effect.amplitudes)
        plain = _without_shape(train, number, count)
        columns = list(range(own + count))
        low = np.array([q.low for q in effect.amplitudes])
        high = np.array([q.high for q in effect.amplitudes])
        found = solve(joined.whole, columns)
        sizes = joined.size[own : own + count]
        regressed = found[own:] / sizes
        amplitudes = np.clip(regressed, low, high)
        found = _beside(joined.whole, own, amplitudes * sizes)
        squares = float(remaining(joined.whole[None], columns, found)[0])
        inside = bool(np.all(amplitudes == regressed))
        gain = gains_beside(plain)[0] if inside else _gain_of(plain, amplitudes)
        take = _along(amplitudes, len(effect.shape), own, joined.size)
        size = np.concatenate([joined.size[: own + count], np.ones(len(effect.shape) + 1)])
        return cls(take.T @ joined.whole @ take, size, gain, squares, tuple(amplitudes.tolist()))

    def step(self, tried: Tried, damping: float) -> tuple[Array, float]:
        """Return the step of the shape, and the squared errors that it promises to take.

        What stands at its bound and would leave it stays there.
        """
        quantities = (*tried.effect.amplitudes, *tried.effect.shape)
        values = np.array([*self.amplitudes, *tried.shape])
        first = len(self.size) - 1 - len(quantities)
        own = first + np.arange(len(quantities))
        shape = own[len(self.amplitudes) :]
        errors = _with_amplitudes(
            self.gram, first, np.array(self.amplitudes) * self.size[own[: len(self.amplitudes)]]
        )
        damped = errors.copy()
        damped[shape, shape] *= 1.0 + damping
        low = np.array([q.low for q in quantities])
        high = np.array([q.high for q in quantities])
        free = np.flatnonzero(np.diag(errors)[:-1] > 0.0)
        while True:
            move = np.zeros(len(errors) - 1)
            move[free] = solve(damped, free)
            change = move[own] / self.size[own]
            held = (change < 0.0) & (values <= low) | (change > 0.0) & (values >= high)
            if not held.any():
                break
            free = np.setdiff1d(free, own[held])
        promised = -float(move @ (2.0 * errors[:-1, -1] + errors[:-1, :-1] @ move))
        plain = np.setdiff1d(free, shape)
        rest = np.zeros_like(move)
        rest[plain] = solve(errors, plain)
        promised += float(rest @ (2.0 * errors[:-1, -1] + errors[:-1, :-1] @ rest))
        return move[shape] / self.size[shape], promised


def _tangent(effect: Effect) -> Effect:
    """Return an effect with the shape's derivatives of each amplitude behind the amplitudes."""
    quantities = (*effect.amplitudes, *effect.shape * len(effect.amplitudes))
    return replace(effect, amplitudes=quantities, build=partial(_tangent_terms, effect=effect))


def _tangent_terms(signals: Signals, shape: Sequence[float], *, effect: Effect) -> list[Term]:
    terms = list(effect.build(signals, shape))
    if effect.shape:
        for one in np.eye(len(terms)):
            terms += effect_terms(Placed(effect, tuple(shape), tuple(one)), signals)[len(one) :]
    return terms


def _along(amplitudes: Array, shapes: int, own: int, size: Array) -> Array:
    """Return the matrix that adds up the derivatives (of each amplitude) of a shape.

    It goes from the columns of `_tangent` behind `own` others, in units of `size`, to those of
    [base, amplitudes, derivatives by the shape, errors].
    """
    first = own + len(amplitudes)
    take = np.zeros((len(size), first + shapes + 1))
    take[:first, :first] = np.eye(first)
    take[-1, -1] = 1.0
    for i, value in enumerate(amplitudes):
        rows = first + i * shapes + np.arange(shapes)
        take[rows, first + np.arange(shapes)] = value * size[rows]
    return take


def _without_shape(train: ColumnEvidence, number: int, amplitudes: int) -> ColumnEvidence:
    """Return the evidence with one candidate only, and only the columns of its amplitudes."""
    b = train.beside[number]
    few = replace(
        b,
        cross=b.cross[:, :, :amplitudes],
        inner=b.inner[:, :amplitudes, :amplitudes],
        size=b.size[:amplitudes],
    )
    return replace(train, beside=(few,))


def _gain_of(plain: ColumnEvidence, amplitudes: Array) -> Array:
    """Return what the one candidate takes of each block (B,) with given amplitudes."""
    joined, own = plain.joined(0), len(plain.size) - 1
    columns = own + np.arange(len(amplitudes))
    base = list(range(own))
    there = without_effect(joined, columns.tolist(), (-amplitudes).tolist())
    return cross_validated(plain, base) - cross_validated(there, base)


def _with_amplitudes(gram: Array, first: int, amplitudes: Array) -> Array:
    """Return the Gram matrix with the errors that given amplitudes leave."""
    take = np.eye(len(gram))
    take[first : first + len(amplitudes), -1] = amplitudes
    return np.asarray(take.T @ gram @ take)


def _beside(gram: Array, own: int, amplitudes: Array) -> Array:
    """Return [base coefficients, amplitudes], the first regressed beside given amplitudes."""
    errors = _with_amplitudes(gram, own, amplitudes)
    return np.concatenate([solve(errors, list(range(own))), amplitudes])
