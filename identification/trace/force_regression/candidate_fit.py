"""Fit one candidate to the missing force beside a model: amplitudes linearly, shapes by steps."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares, lsq_linear, minimize_scalar

from ....model.effects.base import Effect, Placed, Quantity
from ...rounding import DIFFERENCE, TINY, basis_of
from ..force_balance.force_record import GROUPS, ForceModel
from ..force_balance.free_numbers import Shape
from ..search_options import SearchOptions
from .training_records import Evaluated, Training

Array = NDArray[np.float64]

_NARROW = SearchOptions.accuracy
"""Width to which a valley is narrowed along one number of a shape, over its first one."""
_DIFFERENCE = SearchOptions().negligible
_INSIDE = DIFFERENCE
_SHARE, _SHARE_LOG = 1.0 / SearchOptions.resolved, 1.0
"""First steps of a fit: of the distance of the bounds, and of a logarithm."""
_FELL = SearchOptions.accuracy**2


@dataclass(frozen=True)
class Plain:
    """A model at its present numbers and its columns, each record (F, rows, n), without weights."""

    at: Evaluated
    training: Training
    own: list[Array]


@dataclass(frozen=True)
class Beside:
    """A model's columns and missing force, and what of the latter its columns do not explain.

    own: of each record (F, rows, n). groups: of each record (F, 3, rows, n), changes of the forces
    of inputs, inertia and all else. Q: orthonormal basis of `own` over all records. rest: the
    missing force without them.
    """

    at: Evaluated
    training: Training
    own: list[Array]
    groups: list[Array]
    Q: Array
    rest: Array

    @classmethod
    def of(cls, point: ForceModel, training: Training) -> Beside:
        """Return the columns of a model at its present numbers."""
        at = training.at(point)
        groups = training.group_columns(at)
        own = training.columns(at, groups)
        base = flat(own)
        Q = basis_of(base)
        whole = np.concatenate([m.reshape(-1) for m in at.missing])
        return cls(at, training, own, groups, Q, whole - Q @ (Q.T @ whole))

    @cached_property
    def plain(self) -> Plain:
        """The same without weights."""
        return self._without_weights(self.training.plain)

    @cached_property
    def relative(self) -> Plain:
        """The same without weights, where equations hold times any factor relative to their forces:
        a fit may make all of these larger or smaller."""
        free = np.isfinite(self.training.reference)
        if not free.any():
            return self.plain
        flat = self.training.plain
        reference = np.where(free, flat.at(self.at.point).power, np.nan)
        return self._without_weights(replace(flat, reference=reference))

    def _without_weights(self, flat: Training) -> Plain:
        at = flat.at(self.at.point)
        return Plain(at, flat, flat.columns(at, flat.group_columns(at)))

    def scales(self, linear: bool) -> Array:
        """Return the forces of which an effect may be a change of scale, of unit size (k, rows).

        They are those of the inputs, of inertia and of all else at each DOF, with the model's
        effects and without. A linear effect means such a scale, unless it is all that the
        equation's scale is known by.
        """
        return self._forces[self._sets_scale] if linear else self._forces

    @cached_property
    def _forces(self) -> Array:
        n = len(self.at.power)
        found = [
            np.concatenate([(g[kind] * one).reshape(-1) for g in groups])
            for groups in (self.at.groups, self.at.bare)
            for kind in range(len(GROUPS))
            for one in np.eye(n)
        ]
        sizes = np.maximum(np.linalg.norm(found, axis=1), TINY)
        return np.asarray(found / sizes[:, None])

    @cached_property
    def _sets_scale(self) -> NDArray[np.bool_]:
        """Which of these forces alone sets the scale of its equation."""
        scale = self.training.scale
        return np.tile(((scale > 0.0) & (scale.sum(axis=0) == 1.0)).reshape(-1), 2)

    @property
    def squares(self) -> float:
        """Sum of squares of what the columns do not explain."""
        return float(self.rest @ self.rest)

    def without(self, X: Array) -> Array:
        """Return columns (rows, c) without their part in the model's columns."""
        return np.asarray(X - self.Q @ (self.Q.T @ X))

    def fitted(self, effect: Effect, shape: Shape, told: float, keep: bool = False) -> _Fit:
        """Return the best amplitudes of an effect at a shape, and what they leave."""
        forces, pull = self.training.forces(self.at, effect, shape, keep)
        X = flat(forces)
        left = self.without(X)
        amplitudes = _amplitudes(effect, X, left, self.rest, told)
        shrinks = self.training.counts(self.at, amplitudes, pull)
        if np.any(shrinks):
            counted = np.where(shrinks, pull, 0.0)
            pairs = zip(forces, self.at.missing, strict=True)
            also = self.without(flat([f + counted[:, None, :] * m for f, m in pairs]))
            found = _amplitudes(effect, X, also, self.rest, told)
            if np.all(self.training.counts(self.at, found, pull) == shrinks):
                left, amplitudes = also, found
            else:
                # It would gain by forces that grow, which count for no more than they are: at the
                # edge between the two it does nothing.
                amplitudes = np.zeros_like(amplitudes)
        return _Fit(X, left, amplitudes, np.asarray(self.rest - left @ amplitudes))


@dataclass(frozen=True)
class _Fit:
    """Forces of an effect (rows, c), those beside the model, amplitudes (c,), and the rest."""

    X: Array
    left: Array
    amplitudes: Array
    rest: Array


def told_share(effect: Effect, options: SearchOptions) -> float:
    """Return the share of an effect's squared force that must remain beside the model's own."""
    return options.told_exactly if effect.exact else options.told_from_model


def lacked(
    point: ForceModel, effects: Sequence[Effect], training: Training, options: SearchOptions
) -> list[Effect]:
    """Return the effects of a table that a model, the declared one, lacks.

    A linear force that one of its free parameters gives is not among them. It would differ from
    that parameter beside an effect that bends the signals, without being another cause.
    """
    beside = Beside.of(point, training)
    return [
        e
        for e in effects
        if not e.linear
        or any(taken_at(beside, e, s, told_share(e, options)) is not None for s in e.grid)
    ]


def taken_at(beside: Beside, effect: Effect, shape: Shape, told_from_model: float) -> float | None:
    """Return the squared error that an effect takes at a shape.

    None if less than `told_from_model` of its squared force remains beside the model's columns, or
    beside one of its `scales`: it is then a change of the model's parameters, or of a scale.
    """
    fit = beside.fitted(effect, shape, told_from_model, keep=True)
    whole = np.sum(fit.X * fit.X, axis=0)
    remains = np.sum(fit.left * fit.left, axis=0)
    along = (beside.scales(effect.linear) @ fit.X) ** 2
    remains = np.minimum(remains, np.min(whole - along, axis=0, initial=np.inf))
    if not np.any(remains > told_from_model * whole):
        return None
    return float(beside.squares - fit.rest @ fit.rest)


def fitted_candidate(
    beside: Beside, effect: Effect, shape: Shape, told_from_model: float
) -> Placed | None:
    """Return an effect with the numbers that leave least, from a start shape.

    None if it does nothing there, or is a change of the model's parameters, as `taken_at` says: a
    dead zone that is wider than the commands is a gain.
    """

    known: dict[bytes, Array] = {}

    def residual(x: Array) -> Array:
        at = np.asarray(x).tobytes()
        if at not in known:
            known[at] = beside.fitted(effect, _shape(effect.shape, x), told_from_model).rest
        return known[at]

    x = _coordinates(effect.shape, shape)
    if len(x):
        for i, (low, high) in enumerate(_neighbours(effect, x)):
            x = _along(residual, x, i, low, high)
        found = least_squares(
            residual,
            np.clip(x, 1.0 + _INSIDE, 2.0 - _INSIDE),
            bounds=(1.0, 2.0),
            x_scale=[_SHARE_LOG / _reach(q) if q.log else _SHARE for q in effect.shape],
            diff_step=np.full(len(x), _DIFFERENCE),
            max_nfev=SearchOptions.steps,
            ftol=_FELL,
        )
        x = found.x
    end = _shape(effect.shape, x)
    amplitudes = beside.fitted(effect, end, told_from_model).amplitudes
    if not np.any(amplitudes) or taken_at(beside, effect, end, told_from_model) is None:
        return None
    return Placed(effect, end, tuple(amplitudes.tolist()))


def _along(residual: Callable[[Array], Array], x: Array, i: int, low: float, high: float) -> Array:
    """Return coordinates with the `i`-th one where least is left between two bounds.

    A kink, as that of a contact, moves what is left by its curvature more than by its slope: steps
    by slopes creep there.
    """

    def left(value: float) -> float:
        rest = residual(np.concatenate([x[:i], [value], x[i + 1 :]]))
        return float(rest @ rest)

    found = minimize_scalar(
        left, bounds=(low, high), method="bounded", options={"xatol": _NARROW * (high - low)}
    )
    if not found.fun < left(float(x[i])):
        return x
    return np.concatenate([x[:i], [float(found.x)], x[i + 1 :]])


def _neighbours(effect: Effect, x: Array) -> list[tuple[float, float]]:
    """Return for each coordinate those of the grid below and above, or the bounds."""
    grid = np.array([_coordinates(effect.shape, shape) for shape in effect.grid])
    found = []
    for own, column in zip(x.tolist(), grid.T, strict=True):
        apart = np.abs(column - own) > _INSIDE
        below, above = column[apart & (column < own)], column[apart & (column > own)]
        found.append((float(below.max(initial=1.0)), float(above.min(initial=2.0))))
    return found


def flat(columns: Sequence[Array]) -> Array:
    """Return columns of records (c, rows, n) as one matrix (rows of all records, c)."""
    return np.asarray(np.hstack([c.reshape(len(c), math.prod(c.shape[1:])) for c in columns]).T)


def _amplitudes(
    effect: Effect, X: Array, left: Array, rest: Array, told_from_model: float
) -> Array:
    """Return the least-squares amplitudes within their bounds.

    X are the effect's forces, `left` without their part in the model's columns. Combinations of
    which less than `told_from_model` of the square is left get no amplitude: they are the model's.
    """
    size = np.linalg.norm(X, axis=0)
    size = np.where(size > 0.0, size, 1.0)
    if len(size) == 1:
        return _amplitude(effect, float(size[0]), left[:, 0], rest, told_from_model)
    low = np.array([q.low for q in effect.amplitudes]) * size
    high = np.array([q.high for q in effect.amplitudes]) * size
    Q, R = np.linalg.qr(left / size)
    U, s, Vt = np.linalg.svd(R, full_matrices=False)
    told = s > np.sqrt(told_from_model)
    b = U.T @ (Q.T @ rest)
    found = Vt.T @ np.where(told, b / np.where(told, s, 1.0), 0.0)
    if np.any(found < low) or np.any(found > high):
        few = lsq_linear((s * told)[:, None] * Vt, b * told, (low, high), method="bvls")
        found = np.clip(few.x, low, high)
    return np.asarray(found / size)


def _amplitude(
    effect: Effect, size: float, left: Array, rest: Array, told_from_model: float
) -> Array:
    """Return the same of an effect with one amplitude (1,), of which QR and SVD are a division.

    size: norm of its force. left: its force without its part in the model's columns (rows,).
    """
    squares = float(left @ left)
    if not squares > told_from_model * size**2:
        return np.zeros(1)
    (quantity,) = effect.amplitudes
    return np.clip([float(left @ rest) / squares], quantity.low, quantity.high)


def _coordinates(quantities: Sequence[Quantity], shape: Sequence[float]) -> Array:
    """Return shape parameters, or their logarithms, from 1 at the lower bound to 2 at the upper.

    Differences are in proportion to a coordinate, so none may be zero. Start values may be beyond
    the bounds, as the period of a spectrum's line; the fit begins at the bound then.
    """
    pairs = zip(quantities, shape, strict=True)
    found = [1.0 + (_plain(q, v) - _plain(q, q.low)) / _reach(q) for q, v in pairs]
    return np.clip(found, 1.0, 2.0)


def _shape(quantities: Sequence[Quantity], x: Array) -> Shape:
    found = []
    for q, at in zip(quantities, x.tolist(), strict=True):
        value = _plain(q, q.low) + (at - 1.0) * _reach(q)
        found.append(float(np.clip(np.exp(value) if q.log else value, q.low, q.high)))
    return tuple(found)


def _plain(q: Quantity, value: float) -> float:
    return float(np.log(max(value, TINY))) if q.log else value


def _reach(q: Quantity) -> float:
    """Return the distance of the bounds, of their logarithms where the fit is in these."""
    return _plain(q, q.high) - _plain(q, q.low) or 1.0
