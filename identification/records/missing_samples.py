"""Fill in missing measurements from the rows around them and the forces in between."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

_SIDE_ROWS = 12
"""Least number of rows that the curve fits on each side of missing rows."""
_POLYNOMIAL_ORDER = 4
_MIN_WINDOWS = 20
"""Least number of complete windows from which the effect of the forces is estimated."""
_MISFIT_RATIO = 3.0
"""Largest mean square residual around missing rows, over its median in complete windows. With nine
sensors and 24 rows, chance alone spreads it by a tenth."""


def fillable(missing: Mask, longest: int) -> Mask:
    """Return which missing rows (N,) can be filled in: short runs with enough known rows around."""
    found = np.zeros(len(missing), bool)
    for begin, end in runs(missing):
        rows = _around(begin, end, len(missing))
        before, after = rows[rows < begin], rows[rows >= end]
        enough = min((~missing[before]).sum(), (~missing[after]).sum()) > _POLYNOMIAL_ORDER
        found[begin:end] = enough and end - begin <= longest
    return found


def runs(mask: Mask) -> list[tuple[int, int]]:
    """Return begin and end (exclusive) of every run of true rows (N,)."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], mask.astype(np.int8), [0]])))
    return [(int(a), int(b)) for a, b in edges.reshape(-1, 2)]


@dataclass(frozen=True)
class FilledValues:
    """Values (N, S), missing rows filled in.

    `misfit` (N,): in missing rows, the mean square residual of the fit around them over its limit;
    0 elsewhere. Above 1 the known forces do not explain the motion (`inconsistent`).
    """

    values: Array
    misfit: Array

    @property
    def inconsistent(self) -> Mask:
        """Which missing rows (N,) have a misfit beyond chance."""
        return np.asarray(self.misfit > 1.0)


def fill_missing(values: Array, missing: Mask, force: Array) -> FilledValues:
    """Fill in the missing rows (N,) of values (N, S), all in one unit; all rows are `fillable`.

    force (N, C): the force of row k acts over the period that begins with row k + 1. The motion
    over a few rows is the double integral of the forces, times a gain estimated from the record,
    plus the smooth effect of rods, damping and initial state: a polynomial. A known white force
    therefore adds no uncertainty.
    """
    misfit = np.zeros(len(values))
    if not missing.any():
        return FilledValues(values, misfit)
    acting = np.vstack([np.zeros_like(force[:1]), force[:-1]])
    # The polynomial includes a constant force, which would make long sums large.
    sums = _double_sums(acting - acting.mean(axis=0))
    force_gain = _fit_force_gain(values, missing, sums)
    limit = _misfit_limit(values, missing, sums, force_gain)
    out = values.copy()
    for begin, end in runs(missing):
        rows = _around(begin, end, len(values))
        known = ~missing[rows]
        inside = (rows >= begin) & (rows < end)
        forced = _sums_from_rest(sums, rows) @ force_gain
        curve = np.vander(np.linspace(-1.0, 1.0, len(rows)), _POLYNOMIAL_ORDER + 1)
        measured = (values[rows] - forced)[known]
        if len(measured) <= _POLYNOMIAL_ORDER + 1:
            continue
        smooth = np.linalg.lstsq(curve[known], measured, rcond=None)[0]
        out[rows[inside]] = (curve @ smooth + forced)[inside]
        residual = measured - curve[known] @ smooth
        misfit[begin:end] = np.sum(residual**2) / (len(measured) - _POLYNOMIAL_ORDER - 1) / limit
    return FilledValues(out, misfit)


def _around(begin: int, end: int, n: int) -> NDArray[np.int64]:
    """Return the missing rows begin to end and the rows around them that the curve fits."""
    around = max(_SIDE_ROWS, end - begin)
    return np.arange(max(begin - around, 0), min(end + around, n))


def _double_sums(acting: Array) -> tuple[Array, Array]:
    """Return single and double sums (N, C) of forces that are held for one period."""
    start = np.zeros_like(acting[:1])
    once = np.vstack([start, np.cumsum(acting, axis=0)[:-1]])
    twice = np.vstack([start, np.cumsum(once[:-1] + 0.5 * acting[:-1], axis=0)])
    return once, twice


def _sums_from_rest(sums: tuple[Array, Array], rows: NDArray[np.int64]) -> Array:
    """Return double and single sums (rows, 2 C) that start from zero at the first row.

    The single sums model a delay of part of a period, such as a lag.
    """
    once, twice = sums
    first = rows[0]
    once_here = once[rows] - once[first]
    twice_here = twice[rows] - twice[first] - (rows - first)[:, None] * once[first]
    return np.concatenate([twice_here, once_here], axis=1)


def _complete_windows(missing: Mask) -> list[NDArray[np.int64]]:
    """Return the rows of windows without missing rows."""
    length = 2 * _SIDE_ROWS
    starts = range(0, len(missing) - length + 1, length)
    return [np.arange(s, s + length) for s in starts if not missing[s : s + length].any()]


def _misfit_limit(
    values: Array, missing: Mask, sums: tuple[Array, Array], force_gain: Array
) -> float:
    """Return the mean square residual that complete windows do not reach."""
    windows = _complete_windows(missing)
    if len(windows) < _MIN_WINDOWS:
        return np.inf
    basis = _polynomial_basis()
    found = []
    for rows in windows:
        measured = values[rows] - _sums_from_rest(sums, rows) @ force_gain
        residual = measured - basis @ (basis.T @ measured)
        found.append(float(np.sum(residual * residual)) / (2 * _SIDE_ROWS - _POLYNOMIAL_ORDER - 1))
    return max(_MISFIT_RATIO * float(np.median(found)), 2.0 * float(np.quantile(found, 0.9)))


def _fit_force_gain(values: Array, missing: Mask, sums: tuple[Array, Array]) -> Array:
    """Estimate the effect (2 C, S) of the force sums on the values; zeros without enough data."""
    length, windows = 2 * _SIDE_ROWS, _complete_windows(missing)
    columns, sensors = 2 * sums[0].shape[1], values.shape[1]
    if len(windows) < _MIN_WINDOWS or not columns:
        return np.zeros((columns, sensors))
    basis = _polynomial_basis()
    gram, right = np.zeros((columns, columns)), np.zeros((columns, sensors))
    squares = 0.0
    for rows in windows:
        forced, measured = _sums_from_rest(sums, rows), values[rows]
        forced = forced - basis @ (basis.T @ forced)
        gram += forced.T @ forced
        residual = measured - basis @ (basis.T @ measured)
        right += forced.T @ residual
        squares += float(np.sum(residual * residual))
    # Ridge regression: directions in which the forces hardly vary are poorly determined. The ridge
    # is the noise variance over the mean square gain of the strongest direction.
    energy, axes = np.linalg.eigh(gram)
    main = axes[:, -1] @ right / max(energy[-1], 1e-300)
    variance = (squares - energy[-1] * float(main @ main)) / (len(windows) * length * sensors)
    gain_square = float(main @ main) / sensors
    ridge = max(variance, 0.0) / max(gain_square, 1e-300) + 1e-12 * energy[-1]
    return np.asarray(axes @ ((axes.T @ right) / (energy + ridge)[:, None]))


def _polynomial_basis() -> Array:
    """Return orthonormal polynomials over a window (rows, order + 1)."""
    line = np.linspace(-1.0, 1.0, 2 * _SIDE_ROWS)
    return np.asarray(np.linalg.qr(np.vander(line, _POLYNOMIAL_ORDER + 1))[0])
