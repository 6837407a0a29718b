"""Fit a model with effects to the missing force of the training records, weighed by frequency."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import lsq_linear

from ....model.effects.base import Effect, Placed, Quantity
from .force_record import ForceModel, ForceRecord
from .held_out_gain import Blocks, Columns
from .residual_whitening import Whitening

Array = NDArray[np.float64]
Shape = tuple[float, ...]

_HALF_STEP = 1e-4
"""Half step of the central differences, as a share of a parameter's scale."""
_DAMPING = 1e-3
"""Weight of the way from a fit's begin, relative to the columns: what these do not tell apart stays
where it was."""
_STEPS, _HALVINGS = 20, 6
_CONVERGED = 1e-6
"""Share of the squared residual that a step must take for another one."""
_DELAYS = (-2.0, -1.0, 1.0, 2.0, 4.0)
"""Delays in rows, beside the model's own, from which a first fit starts."""


def numbers_of(placed: Placed) -> int:
    """Return the number of an effect's amplitudes and shape parameters."""
    return len(placed.amplitudes) + len(placed.shape)


@dataclass(frozen=True)
class Evaluated:
    """A model at its present numbers: weighed missing force and acting force of each record.

    missing, acting: (rows, n). share (n,): the inputs' force without effects over that with them,
    RMS; missing is multiplied by it.
    """

    point: ForceModel
    missing: list[Array]
    acting: list[Array]
    share: Array

    @property
    def squares(self) -> float:
        """Sum of squares of the missing force."""
        return float(sum(np.sum(m * m) for m in self.missing))


@dataclass(frozen=True)
class Training:
    """The training records with their weights and blocks; columns are free of each record's mean.

    A constant force of each record is unknown, so it is free in every fit.

    relative: errors count relative to the force that acts. If masses are free and the gains of the
    inputs are not, an effect that takes away from the command would otherwise lower the error by
    lowering all forces, although nothing tells the scale of all actuators.
    """

    records: tuple[ForceRecord, ...]
    whitening: Whitening
    blocks: Blocks
    relative: bool = True

    def at(self, point: ForceModel) -> Evaluated:
        """Return the missing force of a model."""
        model, acting = point.model, []
        n = self.records[0].kept[0].shape[1]
        whole, plain = np.zeros(n), np.zeros(n)
        for r in self.records:
            given = force = r.input_force(model)
            for p in point.placed:
                held = r.held_forces(model, p.effect, p.shape)
                force = force + np.tensordot(np.array(p.amplitudes), held, 1)
            acting.append(self._weighed(r, force))
            whole += np.sum(acting[-1] ** 2, axis=0)
            if point.placed:
                plain += np.sum(self._weighed(r, given) ** 2, axis=0)
        share = np.ones(n)
        if self.relative and point.placed:
            share = np.sqrt(np.divide(plain, whole, out=np.ones(n), where=whole > 0.0))
        missing = [share * self._weighed(r, r.missing_force(point)) for r in self.records]
        return Evaluated(point, missing, acting, share)

    def forces(
        self,
        at: Evaluated,
        effect: Effect,
        shape: Shape,
        keep: bool = False,
        plain: bool = False,
    ) -> list[Array]:
        """Return the weighed forces of an effect's amplitudes, each record (amplitudes, rows, n).

        They are the change of the missing force: what an effect takes from the force that acts
        makes the rest count more, unless `plain`. keep: whether filtered signals are kept for the
        next call.
        """
        model = at.point.model
        forces = [
            at.share * self._weighed(r, r.effect_forces(model, effect, shape, keep))
            for r in self.records
        ]
        held = [r.held_forces(model, effect, shape, keep) for r in self.records]
        if not self.relative or plain or not any(np.any(h) for h in held):
            return forces
        power = np.sum([np.sum(f * f, axis=0) for f in at.acting], axis=0)
        power = np.maximum(power, np.finfo(float).tiny)
        white = [self._weighed(r, h) for r, h in zip(self.records, held, strict=True)]
        along = sum(np.sum(h * f, axis=1) for h, f in zip(white, at.acting, strict=True)) / power
        return [
            f + np.asarray(along)[:, None, :] * m for f, m in zip(forces, at.missing, strict=True)
        ]

    def effect_columns(self, at: Evaluated, placed: Placed) -> list[Array]:
        """Return the columns of an effect's amplitudes and shape, each record (c, rows, n)."""
        columns = self.forces(at, placed.effect, placed.shape)
        for i, q in enumerate(placed.effect.shape):
            low, high, width = _steps(q, placed.shape, i)
            lower, upper = (self.forces(at, placed.effect, s) for s in (low, high))
            a = np.array(placed.amplitudes)
            columns = [
                np.concatenate([c, np.tensordot(a, (u - v) / width, 1)[None]])
                for c, u, v in zip(columns, upper, lower, strict=True)
            ]
        return columns

    def columns(self, at: Evaluated) -> list[Array]:
        """Return the columns of all free numbers, each record (F + effects', rows, n).

        Parameters count in their scale.
        """
        point = at.point
        free, values = point.parameters, point.values
        own: list[list[Array]] = []
        for i, scale in enumerate(free.scale.tolist()):
            step = np.zeros(len(values))
            step[i] = _HALF_STEP * scale
            pair = (self._plain_missing(point.with_values(values + s * step)) for s in (-1.0, 1.0))
            own.append([at.share * (a - b) / (2 * _HALF_STEP) for a, b in zip(*pair, strict=True)])
        parts = [self.effect_columns(at, p) for p in point.placed]
        found = []
        for k, record in enumerate(self.records):
            n = record.kept[0].shape[1]
            mine = [c[k][None] for c in own] + [p[k] for p in parts]
            found.append(np.concatenate(mine) if mine else np.zeros((0, record.rows, n)))
        return found

    def plain(self) -> Training:
        """Return the same records without weights."""
        n, limit_hz = self.records[0].kept[0].shape[1], self.whitening.cutoff_hz
        flat = Whitening(np.array([0.0, limit_hz]), np.ones((2, n)), limit_hz)
        return replace(self, whitening=flat)

    def acting_columns(self, at: Evaluated) -> list[Array]:
        """Return the changes of the inputs' force by all free numbers, as `columns`."""
        point = at.point
        free, values = point.parameters, point.values
        own: list[list[Array]] = []
        for i, scale in enumerate(free.scale.tolist()):
            step = np.zeros(len(values))
            step[i] = _HALF_STEP * scale
            models = [point.with_values(values + s * step).model for s in (-1.0, 1.0)]
            own.append(
                [
                    self._weighed(r, (r.input_force(models[1]) - r.input_force(models[0])))
                    / (2 * _HALF_STEP)
                    for r in self.records
                ]
            )
        parts = [self.acting_of(at, p) for p in point.placed]
        return [
            np.concatenate(
                [
                    np.zeros((0, *r.kept[0].shape)),
                    *(c[k][None] for c in own),
                    *(p[k] for p in parts),
                ]
            )
            for k, r in enumerate(self.records)
        ]

    def acting_of(self, at: Evaluated, placed: Placed) -> list[Array]:
        """Return the changes of the inputs' force by an effect's amplitudes and shape."""
        model, a = at.point.model, np.array(placed.amplitudes)
        found = []
        for r in self.records:
            own = [r.held_forces(model, placed.effect, placed.shape)]
            for i, q in enumerate(placed.effect.shape):
                low, high, width = _steps(q, placed.shape, i)
                lower, upper = (r.held_forces(model, placed.effect, s) for s in (low, high))
                own.append(np.tensordot(a, (upper - lower) / width, 1)[None])
            found.append(self._weighed(r, np.concatenate(own)))
        return found

    def _plain_missing(self, point: ForceModel) -> list[Array]:
        return [self._weighed(r, r.missing_force(point)) for r in self.records]

    def prior(self, point: ForceModel) -> Array:
        """Return the Gram matrix of the parameters' priors, for [columns, missing]."""
        rows = point.parameters.prior_rows(point.values)
        count = len(point.values) + sum(numbers_of(p) for p in point.placed)
        whole = np.zeros((len(rows), count + 1))
        whole[:, : len(point.values)] = rows[:, :-1]
        whole[:, -1] = -rows[:, -1]
        return np.asarray(whole.T @ whole)

    def fit(self, point: ForceModel) -> ForceModel:
        """Return the point with all numbers fitted, by Gauss-Newton steps within the bounds."""
        squares, begin = self._cost(point), point
        for _ in range(_STEPS):
            step = self._step(point, _way(begin, point))
            for halving in range(_HALVINGS):
                moved = _moved(point, step * 0.5**halving)
                after = self._cost(moved)
                if after < squares:
                    break
            else:
                return point
            fell, point, squares = squares - after, moved, after
            if fell < _CONVERGED * squares:
                break
        return point

    def first_fit(self, point: ForceModel) -> ForceModel:
        """Return the best fit from several delays, as the squares have minima over a delay."""
        fits = [self.fit(point)]
        free, Ts_s = point.parameters, self.records[0].band.Ts_s
        for i, name in enumerate(free.names):
            if name in point.model.delay.names:
                for rows in _DELAYS:
                    values = point.values
                    values[i] += rows * Ts_s
                    if free.low[i] <= values[i] <= free.high[i]:
                        fits.append(self.fit(point.with_values(values)))
        return min(fits, key=self._cost)

    def judged(
        self,
        at: Evaluated,
        own: Sequence[Array],
        acting: Sequence[Array],
        more: Placed | None = None,
    ) -> Columns:
        """Return the Gram matrices of a model, with one more effect if given.

        own, acting: `columns` and `acting_columns` of the model.
        """
        prior = self.prior(at.point)
        columns, changes = list(own), list(acting)
        if more is not None:
            extra, pushes = self.effect_columns(at, more), self.acting_of(at, more)
            columns = [np.concatenate(pair) for pair in zip(own, extra, strict=True)]
            changes = [np.concatenate(pair) for pair in zip(acting, pushes, strict=True)]
            base, count = len(own[0]), numbers_of(more)
            wide = np.zeros((base + count + 1, base + count + 1))
            pick = [*range(base), base + count]
            wide[np.ix_(pick, pick)] = prior
            prior = wide
        power = self.blocks.grams(changes, at.acting).sum(axis=0)  # over blocks
        return Columns(self.blocks.grams(columns, at.missing), power, prior)

    def _cost(self, point: ForceModel) -> float:
        rows = point.parameters.prior_rows(point.values)
        return self.at(point).squares + float(np.sum(rows[:, -1] ** 2))

    def _step(self, point: ForceModel, way: Array) -> Array:
        """Return the Gauss-Newton step of all free numbers, within the bounds.

        way: from the fit's begin to the point.
        """
        at = self.at(point)
        A = np.hstack([c.reshape(len(c), -1) for c in self.columns(at)]).T
        b = np.concatenate([m.reshape(-1) for m in at.missing])
        rows = point.parameters.prior_rows(point.values)
        if len(rows):
            wide = np.zeros((len(rows), A.shape[1]))
            wide[:, : rows.shape[1] - 1] = rows[:, :-1]
            A, b = np.vstack([A, wide]), np.concatenate([b, -rows[:, -1]])
        size = np.linalg.norm(A, axis=0)
        size = np.where(size > 0.0, size, 1.0)
        Q, R = np.linalg.qr(A / size)
        damped = np.vstack([R, _DAMPING * np.eye(len(size))])
        low, high = _room(point)
        target = np.concatenate([Q.T @ b, -_DAMPING * size * way])
        return np.asarray(lsq_linear(damped, target, (low * size, high * size)).x / size)

    def _weighed(self, record: ForceRecord, values: Array) -> Array:
        white = self.whitening.apply(values, record.band.row_s)
        return np.asarray(white - white.mean(axis=-2, keepdims=True))


def _way(begin: ForceModel, point: ForceModel) -> Array:
    """Return the change of all free numbers, parameters in their scale."""
    parts = [(point.values - begin.values) / point.parameters.scale]
    for old, new in zip(begin.placed, point.placed, strict=True):
        parts.append(np.subtract([*new.amplitudes, *new.shape], [*old.amplitudes, *old.shape]))
    return np.concatenate(parts)


def _steps(q: Quantity, shape: Shape, i: int) -> tuple[Shape, Shape, float]:
    """Return the shapes below and above, within the bounds, and their distance."""
    step = 1e-3 * abs(shape[i]) if q.log else 1e-5 * (q.high - q.low)
    low, high = list(shape), list(shape)
    low[i], high[i] = max(low[i] - step, q.low), min(high[i] + step, q.high)
    return tuple(low), tuple(high), high[i] - low[i]


def _room(point: ForceModel) -> tuple[Array, Array]:
    """Return how far each free number may move down and up; at a bound a little, to be free."""
    free, values = point.parameters, point.values
    low = list((free.low - values) / free.scale)
    high = list((free.high - values) / free.scale)
    for p in point.placed:
        for q, value in zip(
            (*p.effect.amplitudes, *p.effect.shape), (*p.amplitudes, *p.shape), strict=True
        ):
            down, up = q.low - value, q.high - value
            if q.log:  # a long step in a logarithm is none that a line describes
                down, up = max(down, -0.5 * value), min(up, value)
            low.append(down)
            high.append(up)
    least = np.finfo(float).eps
    return np.minimum(low, -least), np.maximum(high, least)


def _moved(point: ForceModel, step: Array) -> ForceModel:
    """Return the point moved by a step of all free numbers."""
    free = point.parameters
    count = len(free.names)
    values = np.clip(point.values + step[:count] * free.scale, free.low, free.high)
    placed, at = [], count
    for p in point.placed:
        numbers = np.array([*p.amplitudes, *p.shape]) + step[at : at + numbers_of(p)]
        quantities = (*p.effect.amplitudes, *p.effect.shape)
        numbers = np.clip(numbers, [q.low for q in quantities], [q.high for q in quantities])
        split = len(p.amplitudes)
        placed.append(p.with_values(numbers[split:].tolist(), numbers[:split].tolist()))
        at += numbers_of(p)
    return replace(point.with_values(values), placed=tuple(placed))
