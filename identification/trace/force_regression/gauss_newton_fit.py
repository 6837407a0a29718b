"""Fit all numbers of a model with effects to the missing force, by damped Gauss-Newton steps."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from math import ceil, log2

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import lsq_linear

from ...rounding import DIFFERENCE, ROUNDING
from ..force_balance.force_record import ForceModel
from ..force_balance.free_numbers import moved_by, room, silent_numbers, way
from ..search_options import SearchOptions
from .training_records import Evaluated, Training

Array = NDArray[np.float64]

HALVINGS = ceil(-log2(SearchOptions.accuracy))
"""Halvings of a step, until it is an error of an equation."""
_DAMPING = SearchOptions().negligible
"""Weight of the way from a fit's begin, relative to the columns: what these do not tell apart stays
where it was."""
_HOPELESS = SearchOptions.least_gain
_CONVERGED = DIFFERENCE
"""Share of the squared residual that a step must take for another one."""
_DELAYS = (-2, -1, 1, 2, SearchOptions.resolved)
"""Delays in rows, beside the model's own, from which a first fit starts."""


def fit_numbers(training: Training, point: ForceModel, rival: float = 0.0) -> ForceModel:
    """Return the point with all numbers fitted, by Gauss-Newton steps within the bounds.

    rival: cost of a model that this one must reach to matter. The fit ends early once its steps
    have become a tenth of the way to there, as they become shorter still.

    Errors relative to forces that the numbers change are not linear in these: far from the end
    a step may lead anywhere. Absolute errors are linear; with one parameter of each such
    equation held, a fit to them leads near.
    """
    if not point.parameters.names and not point.placed:
        return point
    free = np.isfinite(training.reference)
    if not free.any():
        return _fit_from(training, point, rival)
    held = _setting_scale(training, point, free)
    others = [i for i in range(len(point.parameters.names)) if i not in held]
    absolute = replace(training, reference=np.full(len(free), np.nan))
    near = _fit_from(absolute, replace(point, parameters=point.parameters.only(others)), 0.0)
    begins = point, replace(near, parameters=point.parameters)
    return min((_fit_from(training, begin, rival) for begin in begins), key=training.cost)


def _setting_scale(training: Training, point: ForceModel, free: NDArray[np.bool_]) -> set[int]:
    """Return the number of one parameter for each equation that is `free` (n,) in its scale:
    the one that changes the force which sets the scale most."""
    changes = training.parameter_changes(training.at(point))
    sizes = np.sum([np.sum(c * c, axis=2) for c in changes], axis=0)  # (F, groups, n)
    own = np.einsum("fkn,kn->fn", sizes, training.scale)
    return {int(np.argmax(own[:, i])) for i in np.flatnonzero(free) if len(own)}


def _fit_from(training: Training, point: ForceModel, rival: float) -> ForceModel:
    squares, begin = training.cost(point), point
    for _ in range(SearchOptions.steps):
        step, _ = gauss_newton_step(training, point, way(begin, point))
        for halving in range(HALVINGS):
            moved = moved_by(point, step * 0.5**halving)
            after = training.cost(moved)
            if after < squares:
                break
        else:
            return point
        fell, point, squares = squares - after, moved, after
        if fell < max(_CONVERGED * squares, _HOPELESS * (squares - rival if rival else 0.0)):
            break
    return point


def first_fit(training: Training, point: ForceModel) -> ForceModel:
    """Return the best fit from several delays, as the squares have minima over a delay."""
    fits = [fit_numbers(training, point)]
    free, Ts_s = point.parameters, training.records[0].band.Ts_s
    for i, name in enumerate(free.names):
        if name in point.model.delay.names:
            for rows in _DELAYS:
                values = point.values
                values[i] += rows * Ts_s
                if free.low[i] <= values[i] <= free.high[i]:
                    fits.append(fit_numbers(training, point.with_values(values)))
    return min(fits, key=training.cost)


def gauss_newton_step(
    training: Training, point: ForceModel, gone: Array, instruments: Training | None = None
) -> tuple[Array, Array]:
    """Return a Gauss-Newton step of all free numbers, and the part of the missing force for it.

    The step is within the bounds. gone: way from the fit's begin to the point. instruments:
    records whose columns the missing force is projected on, instead of these records' own.
    """
    at = training.at(point)
    changes = training.group_columns(at)
    A, b = _regression_at(training, at, changes)
    Z = A if instruments is None else _regression(instruments, point)[0]
    of_instruments = np.linalg.norm(Z, axis=0)
    Q = np.linalg.qr(Z / np.where(of_instruments > 0.0, of_instruments, 1.0))[0]
    asked, scales = Q.T @ b, _free_scales(training, at, changes)
    A = np.hstack([A, A @ scales])
    size = np.linalg.norm(A, axis=0)
    size = np.where(size > 0.0, size, 1.0)
    damped = np.vstack([Q.T @ (A / size), _DAMPING * np.eye(len(size))])
    gone = np.concatenate([gone, np.zeros(scales.shape[1])])
    target = np.concatenate([asked, -_DAMPING * size * gone])
    low, high = room(point)
    least, most = _room_along(scales, low, high)
    limits = np.append(low, least) * size, np.append(high, most) * size
    step = lsq_linear(damped, target, limits).x / size
    return np.asarray(step[: len(low)] + scales @ step[len(low) :]), asked


def _free_scales(training: Training, at: Evaluated, changes: Sequence[Array]) -> Array:
    """Return the ways of all free numbers (C, k) along which all forces of an equation change
    in proportion, for each of the k equations whose terms are all free.

    Errors relative to these forces stay as they are, so only other equations tell how far to
    go. The numbers' own columns grow as the numbers become small; damping relative to them
    would stop a fit there, so each way is a column of its own.
    """
    found = []
    for i in np.flatnonzero(np.isfinite(training.reference) & training.all_free):
        J = np.concatenate([c[..., i].reshape(len(c), -1) for c in changes], axis=1).T
        force = np.concatenate([g[..., i].reshape(-1) for g in at.groups])
        length = np.linalg.norm(J, axis=0)
        length = np.where(length > 0.0, length, 1.0)
        part = np.linalg.lstsq(J / length, force, rcond=ROUNDING)[0]
        part[np.abs(part) < ROUNDING * np.abs(part).max(initial=0.0)] = 0.0
        found.append(part / length)
    return np.array(found).reshape(len(found), len(changes[0])).T


def _regression(training: Training, point: ForceModel) -> tuple[Array, Array]:
    """Return the columns of all free numbers (rows, C) and the missing force (rows,), and below
    both the parameters' priors."""
    at = training.at(point)
    return _regression_at(training, at, training.group_columns(at))


def _regression_at(
    training: Training, at: Evaluated, changes: Sequence[Array]
) -> tuple[Array, Array]:
    point, columns = at.point, training.columns(at, changes, shrinks=True)
    A = np.hstack([c.reshape(len(c), -1) for c in columns]).T
    A[:, silent_numbers(point, np.linalg.norm(A, axis=0), float(at.power.sum()))] = 0.0
    b = np.concatenate([m.reshape(-1) for m in at.missing])
    rows = point.parameters.prior_rows(point.values)
    if len(rows):
        wide = np.zeros((len(rows), A.shape[1]))
        wide[:, : rows.shape[1] - 1] = rows[:, :-1]
        A, b = np.vstack([A, wide]), np.concatenate([b, -rows[:, -1]])
    return A, b


def _room_along(ways: Array, low: Array, high: Array) -> tuple[Array, Array]:
    """Return how far down and up each way (C, k) of all numbers stays within their room (C,): (k,).

    Down at most by half: at zero an equation says nothing.
    """
    ends = [np.divide(r[:, None], ways, out=np.full(ways.shape, np.inf), where=ways != 0.0)
            for r in (low, high)]  # fmt: skip
    least = np.where(ways > 0.0, ends[0], -np.abs(ends[1])).max(axis=0, initial=-0.5)
    most = np.where(ways < 0.0, np.abs(ends[0]), ends[1]).min(axis=0, initial=np.inf)
    tiny = np.finfo(float).eps
    return np.minimum(least, -tiny), np.maximum(most, tiny)
