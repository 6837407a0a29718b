"""Keep signals in full, or as minima and maxima of short bins, for interactive charts."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import TYPE_CHECKING
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:  # the commands import this module before they need matplotlib
    from matplotlib.artist import Artist

Array = NDArray[np.float64]

MOST_BINS = 1 << 17
"""Most bins of one signal that are kept in memory; a page has fewer (see chart_encoding)."""
_MOST_GAPS = 256


@dataclass(frozen=True)
class Bins:
    """Consecutive bins of `count` samples each: first time, minimum and maximum t, low, high (B,).

    The last bin may hold fewer samples. A missing value is NaN. `kept` bins are single samples
    that no page makes coarser. Within one `Bins` the time steps are equal, unless the signal has
    no regular rate.
    """

    t: Array
    low: Array
    high: Array
    count: int
    kept: bool = False

    def coarser(self, factor: int) -> Bins:
        """Return bins of `factor` times as many samples."""
        if factor <= 1 or not len(self.t):
            return self
        starts = np.arange(0, len(self.t), factor)
        low, high = np.fmin.reduceat(self.low, starts), np.fmax.reduceat(self.high, starts)
        return replace(self, t=self.t[starts], low=low, high=high, count=factor * self.count)

    def scaled(self, factor: float) -> Bins:
        """Return the bins in another unit."""
        low, high = (self.low, self.high) if factor > 0 else (self.high, self.low)
        return replace(self, low=factor * low, high=factor * high)


Samples = tuple[Bins, ...]
"""A signal in order of time."""


def min_max_bins(
    t: NDArray[np.floating],
    low: NDArray[np.floating],
    high: NDArray[np.floating],
    *,
    most: int | None = None,
    keep: Sequence[tuple[int, int]] = (),
) -> Samples:
    """Return the samples low, high (n,) at t (n,) in at most about `most` bins of equal count.

    Rows in the half-open ranges `keep`, sorted and disjoint, remain single samples. The number of
    samples in a bin is a power of two. Without `most`, MOST_BINS applies, or no limit inside
    `all_samples`.
    """
    n = len(t)
    limit = None if _ALL.get() else MOST_BINS if most is None else most
    count = 1
    while limit is not None and n > limit * count:
        count *= 2
    cuts = sorted({0, n, *_gaps(t), *(edge for span in keep for edge in span)})
    inside = np.zeros(n, bool)
    for start, end in keep:
        inside[start:end] = True
    parts = []
    for a, b in pairwise(cuts):
        rows = slice(a, b)
        run_t, run_low, run_high = (np.asarray(x[rows], float) for x in (t, low, high))
        run = Bins(run_t, run_low, run_high, 1, bool(inside[a]))
        parts.append(run if run.kept else run.coarser(count))
    return tuple(part for part in parts if len(part.t))


def _gaps(t: NDArray[np.floating]) -> list[int]:
    """Return the rows before which time is missing; none for a signal without a regular rate."""
    steps = np.diff(t)
    if not steps.size:
        return []
    rows = np.flatnonzero(steps > 1.5 * np.median(steps)) + 1
    return rows.tolist() if len(rows) <= _MOST_GAPS else []


_ATTACHED: WeakKeyDictionary[Artist, Samples] = WeakKeyDictionary()


def attach(artist: Artist, samples: Samples) -> None:
    """Give a drawn line or band the samples that the interactive chart shows in its place.

    Without samples (an empty tuple) the chart omits the artist.
    """
    _ATTACHED[artist] = samples


def attached(artist: Artist) -> Samples | None:
    """Return the samples attached to an artist, or None."""
    return _ATTACHED.get(artist)


_ALL: ContextVar[bool] = ContextVar("all_samples", default=False)


@contextmanager
def all_samples(full: bool = True) -> Iterator[None]:
    """Embed every sample in the pages written in the `with` body, however large they become."""
    token = _ALL.set(full)
    try:
        yield
    finally:
        _ALL.reset(token)


def embeds_all_samples() -> bool:
    """Return whether pages written now embed every sample."""
    return _ALL.get()
