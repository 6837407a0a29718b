"""Compute binned means of one signal over another, with errors and explained share."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..search_options import SearchOptions

Array = NDArray[np.float64]

_BINS = SearchOptions.blocks
_OUTSIDE = 0.5 * SearchOptions.accuracy
_FEWEST = SearchOptions.resolved
"""Least number of time blocks in a bin, for its error."""


@dataclass(frozen=True)
class Dependence:
    """Means (K,) of values over bins of a signal, at the signal's means `at` (K,).

    error (K,): standard error of each mean, from the scatter between time blocks, which allows for
    correlation within a block. share: cross-validated share of the values' power that the means
    explain; near or below zero without dependence.
    """

    at: Array
    mean: Array
    error: Array
    share: float


def dependence(signal: Array, values: Array, block: NDArray[np.int64]) -> Dependence:
    """Return binned means of values (N,) over a signal (N,); `block` (N,): time block numbers."""
    edges = _edges(signal)
    inside = (signal >= edges[0]) & (signal <= edges[-1])
    x, y = signal[inside], values[inside]
    _, b = np.unique(block[inside], return_inverse=True)
    number = np.clip(np.searchsorted(edges, x, "right") - 1, 0, len(edges) - 2)
    bins, blocks = len(edges) - 1, int(b.max(initial=0)) + 1
    count, sums, places = (
        np.asarray(np.bincount(number * blocks + b, weights, bins * blocks), float).reshape(
            bins, blocks
        )
        for weights in (np.ones(len(x)), y, x)
    )
    rows = count.sum(axis=1)
    kept = (count > 0).sum(axis=1) >= _FEWEST
    total = np.maximum(rows, 1.0)
    mean = sums.sum(axis=1) / total
    # The standard error of a ratio of sums over blocks (cluster sampling).
    scatter = sums - mean[:, None] * count
    error = np.sqrt((scatter**2).sum(axis=1) * blocks / max(blocks - 1, 1)) / total
    at = places.sum(axis=1) / total
    return Dependence(at[kept], mean[kept], error[kept], _share(count, sums, y, number, b))


def _edges(signal: Array) -> Array:
    """Return the edges (K + 1,) of equally wide bins over 99 % of the signal."""
    low, high = np.quantile(signal, (_OUTSIDE, 1.0 - _OUTSIDE))
    if not high > low:
        low, high = low - 0.5, low + 0.5
    return np.linspace(low, high, _BINS + 1)


def _share(
    count: Array,
    sums: Array,
    values: Array,
    number: NDArray[np.int64],
    block: NDArray[np.int64],
) -> float:
    """Return the share that the means of every second block explain of the others (two-fold)."""
    left, whole = 0.0, 0.0
    odd = np.arange(count.shape[1]) % 2 == 1
    for half in (odd, ~odd):
        rows = count[:, half].sum(axis=1)
        mean = sums[:, half].sum(axis=1) / np.maximum(rows, 1.0)
        other = ~half[block]
        left += float(np.sum((values[other] - mean[number[other]]) ** 2))
        whole += float(np.sum(values[other] ** 2))
    return 1.0 - left / whole if whole > 0 else 0.0
