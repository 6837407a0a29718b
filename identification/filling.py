"""Measurements that are missing, from those around them and from the forces in between."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

_AROUND = 12
"""Rows on each side of a gap that a curve is laid through, at least."""
_ORDER = 4
_WINDOWS = 20
"""Windows without a gap that it takes, at least, to learn what a force does."""


def filled(values: Array, missing: Mask, force: Array) -> Array:
    """Return values (N, S) with those of `missing` rows (N,) filled in.

    force (N, C): that of row k acts over the period that begins with row k + 1. What a body does
    over some rows is the double integral of its forces, times something constant that the record
    tells, plus what rods, damping and the state at the start do, which is smooth: a polynomial. So
    a white force of known values makes a gap no less certain.
    """
    if not missing.any():
        return values
    n = len(values)
    acting = np.vstack([np.zeros_like(force[:1]), force[:-1]])
    # A constant is part of the curve, and would make long sums large.
    sums = _double_sums(acting - acting.mean(axis=0))
    by_force = _by_force(values, missing, sums)
    out = values.copy()
    edges = np.flatnonzero(np.diff(np.concatenate([[0], missing.astype(np.int8), [0]])))
    for begin, end in edges.reshape(-1, 2).tolist():
        around = max(_AROUND, end - begin)
        rows = np.arange(max(begin - around, 0), min(end + around, n))
        there = ~missing[rows]
        gap = (rows >= begin) & (rows < end)
        left, right = there[: begin - rows[0]].sum(), there[end - rows[0] :].sum()
        if min(left, right) <= _ORDER:  # no curve leads out of a record's end
            known = np.flatnonzero(~missing)
            for column, target in zip(values.T, out.T, strict=True):
                target[rows[gap]] = np.interp(rows[gap], known, column[known])
            continue
        pushed = _from_start(sums, rows) @ by_force
        curve = np.vander(np.linspace(-1.0, 1.0, len(rows)), _ORDER + 1)
        smooth = np.linalg.lstsq(curve[there], (values[rows] - pushed)[there], rcond=None)[0]
        out[rows[gap]] = (curve @ smooth + pushed)[gap]
    return out


def _double_sums(acting: Array) -> tuple[Array, Array]:
    """Return first and second sums (N, C) of forces held over the period that follows a row."""
    start = np.zeros_like(acting[:1])
    once = np.vstack([start, np.cumsum(acting, axis=0)[:-1]])
    twice = np.vstack([start, np.cumsum(once[:-1] + 0.5 * acting[:-1], axis=0)])
    return once, twice


def _from_start(sums: tuple[Array, Array], rows: NDArray[np.int64]) -> Array:
    """Return the second sums over some rows, at rest at the first of them."""
    once, twice = sums
    first = rows[0]
    return np.asarray(twice[rows] - twice[first] - (rows - first)[:, None] * once[first])


def _by_force(values: Array, missing: Mask, sums: tuple[Array, Array]) -> Array:
    """Return what a double sum of forces does to the values, (C, S); zeros if nobody can tell."""
    length = 2 * _AROUND
    starts = np.arange(0, len(values) - length + 1, length)
    starts = [s for s in starts.tolist() if not missing[s : s + length].any()]
    coils, sensors = sums[0].shape[1], values.shape[1]
    if len(starts) < _WINDOWS:
        return np.zeros((coils, sensors))
    smooth = np.linalg.qr(np.vander(np.linspace(-1.0, 1.0, length), _ORDER + 1))[0]
    gram, right = np.zeros((coils, coils)), np.zeros((coils, sensors))
    for start in starts:
        rows = np.arange(start, start + length)
        pushed, seen = _from_start(sums, rows), values[rows]
        pushed = pushed - smooth @ (smooth.T @ pushed)
        gram += pushed.T @ pushed
        right += pushed.T @ (seen - smooth @ (smooth.T @ seen))
    return np.asarray(np.linalg.pinv(gram, rcond=1e-9, hermitian=True) @ right)
