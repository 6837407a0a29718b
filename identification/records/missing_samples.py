"""Measurements that are missing, from those around them and from the forces in between."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

_AROUND = 12
"""Rows on each side of a gap that a curve is laid through, at least."""
_ORDER = 4
_WINDOWS = 20
"""Windows without a gap that it takes, at least, to learn what a force does."""
_STRAINED = 3.0
"""How many times the usual mean square what a curve leaves around a gap may be. With nine sensors
and 24 rows chance alone spreads it by a tenth."""


def bridged(missing: Mask, longest: int) -> Mask:
    """Return which `missing` rows (N,) can be filled in: in short gaps with enough around them."""
    found = np.zeros(len(missing), bool)
    for begin, end in runs(missing):
        rows = _around(begin, end, len(missing))
        before, behind = rows[rows < begin], rows[rows >= end]
        enough = min((~missing[before]).sum(), (~missing[behind]).sum()) > _ORDER
        found[begin:end] = enough and end - begin <= longest
    return found


def runs(mask: Mask) -> list[tuple[int, int]]:
    """Return begin and end (row after the last) of every run of true rows (N,)."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], mask.astype(np.int8), [0]])))
    return [(int(a), int(b)) for a, b in edges.reshape(-1, 2)]


@dataclass(frozen=True)
class Filled:
    """Values (N, S) with those of missing rows filled in.

    `misfit` (N,): in the rows of a gap, how badly its two sides fit together, as a mean square over
    what that may be; 0 elsewhere. Beyond 1 a force was not what it is taken for (`strained`).
    """

    values: Array
    misfit: Array

    @property
    def strained(self) -> Mask:
        """Rows (N,) of gaps whose misfit no gap has by chance."""
        return np.asarray(self.misfit > 1.0)


def filled(values: Array, missing: Mask, force: Array) -> Filled:
    """Return values (N, S), all in one unit, with `missing` rows (N,) filled in; all are `bridged`.

    force (N, C): that of row k acts over the period that begins with row k + 1. What a body does
    over some rows is the double integral of its forces, times something constant that the record
    tells, plus what rods, damping and the state at the start do, which is smooth: a polynomial. So
    a white force of known values makes a gap no less certain.
    """
    misfit = np.zeros(len(values))
    if not missing.any():
        return Filled(values, misfit)
    acting = np.vstack([np.zeros_like(force[:1]), force[:-1]])
    # A constant is part of the curve, and would make long sums large.
    sums = _double_sums(acting - acting.mean(axis=0))
    by_force = _by_force(values, missing, sums)
    usual = _usual_misfit(values, missing, sums, by_force)
    out = values.copy()
    for begin, end in runs(missing):
        rows = _around(begin, end, len(values))
        there = ~missing[rows]
        gap = (rows >= begin) & (rows < end)
        pushed = _from_start(sums, rows) @ by_force
        curve = np.vander(np.linspace(-1.0, 1.0, len(rows)), _ORDER + 1)
        seen = (values[rows] - pushed)[there]
        if len(seen) <= _ORDER + 1:
            continue
        smooth = np.linalg.lstsq(curve[there], seen, rcond=None)[0]
        out[rows[gap]] = (curve @ smooth + pushed)[gap]
        left = np.sum(np.square(seen - curve[there] @ smooth)) / (len(seen) - _ORDER - 1)
        misfit[begin:end] = left / usual
    return Filled(out, misfit)


def _around(begin: int, end: int, n: int) -> NDArray[np.int64]:
    """Return the rows that a gap is filled in from, and its own."""
    around = max(_AROUND, end - begin)
    return np.arange(max(begin - around, 0), min(end + around, n))


def _double_sums(acting: Array) -> tuple[Array, Array]:
    """Return first and second sums (N, C) of forces held over the period that follows a row."""
    start = np.zeros_like(acting[:1])
    once = np.vstack([start, np.cumsum(acting, axis=0)[:-1]])
    twice = np.vstack([start, np.cumsum(once[:-1] + 0.5 * acting[:-1], axis=0)])
    return once, twice


def _from_start(sums: tuple[Array, Array], rows: NDArray[np.int64]) -> Array:
    """Return second and first sums (rows, 2 C) over some rows, at rest at the first of them.

    The first sums are there for what delays a force by a part of a period, as a lag does.
    """
    once, twice = sums
    first = rows[0]
    once_here = once[rows] - once[first]
    twice_here = twice[rows] - twice[first] - (rows - first)[:, None] * once[first]
    return np.concatenate([twice_here, once_here], axis=1)


def _whole_windows(missing: Mask) -> list[NDArray[np.int64]]:
    """Return the rows of windows that have no gap."""
    length = 2 * _AROUND
    starts = range(0, len(missing) - length + 1, length)
    return [np.arange(s, s + length) for s in starts if not missing[s : s + length].any()]


def _usual_misfit(
    values: Array, missing: Mask, sums: tuple[Array, Array], by_force: Array
) -> float:
    """Return the misfit, as a mean square, that a window without a gap does not reach."""
    windows = _whole_windows(missing)
    if len(windows) < _WINDOWS:
        return np.inf
    rough = np.linalg.qr(np.vander(np.linspace(-1.0, 1.0, 2 * _AROUND), _ORDER + 1))[0]
    found = []
    for rows in windows:
        seen = values[rows] - _from_start(sums, rows) @ by_force
        left = seen - rough @ (rough.T @ seen)
        found.append(float(np.sum(left * left)) / (2 * _AROUND - _ORDER - 1))
    return max(_STRAINED * float(np.median(found)), 2.0 * float(np.quantile(found, 0.9)))


def _by_force(values: Array, missing: Mask, sums: tuple[Array, Array]) -> Array:
    """Return what the sums of forces do to the values, (2 C, S); zeros if nobody can tell."""
    length, windows = 2 * _AROUND, _whole_windows(missing)
    columns, sensors = 2 * sums[0].shape[1], values.shape[1]
    if len(windows) < _WINDOWS or not columns:
        return np.zeros((columns, sensors))
    smooth = np.linalg.qr(np.vander(np.linspace(-1.0, 1.0, length), _ORDER + 1))[0]
    gram, right = np.zeros((columns, columns)), np.zeros((columns, sensors))
    squares = 0.0
    for rows in windows:
        pushed, seen = _from_start(sums, rows), values[rows]
        pushed = pushed - smooth @ (smooth.T @ pushed)
        gram += pushed.T @ pushed
        rough = seen - smooth @ (smooth.T @ seen)
        right += pushed.T @ rough
        squares += float(np.sum(rough * rough))
    # Forces that hardly occur say hardly anything of what they do: it is taken to be nothing, give
    # or take what the force does that occurs most. Its size and the noise are told by the record.
    energy, axes = np.linalg.eigh(gram)
    main = axes[:, -1] @ right / max(energy[-1], 1e-300)
    variance = (squares - energy[-1] * float(main @ main)) / (len(windows) * length * sensors)
    usual = float(main @ main) / sensors
    ridge = max(variance, 0.0) / max(usual, 1e-300) + 1e-12 * energy[-1]
    return np.asarray(axes @ ((axes.T @ right) / (energy + ridge)[:, None]))
