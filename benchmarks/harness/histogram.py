"""Times of very many cycles as counts, small enough to keep a round in a line of text."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike

_BINS_A_US = 100


@dataclass
class Histogram:
    """Counts by hundredths of a microsecond, rounded down."""

    counts: Counter[int] = field(default_factory=Counter)

    @classmethod
    def of(cls, times_us: ArrayLike) -> Histogram:
        """Return the histogram of times in us."""
        bins = np.floor(np.asarray(times_us, dtype=np.float64) * _BINS_A_US + 1e-6).astype(np.int64)
        values, counts = np.unique(bins, return_counts=True)
        return cls(Counter(dict(zip(values.tolist(), counts.tolist(), strict=True))))

    @classmethod
    def counted(cls, times_us: ArrayLike, counts: ArrayLike) -> Histogram:
        """Return the histogram of times in us that came so often each."""
        bins = np.floor(np.asarray(times_us, dtype=np.float64) * _BINS_A_US + 1e-6).astype(np.int64)
        found: Counter[int] = Counter()
        for bin_, count in zip(bins.tolist(), np.asarray(counts).tolist(), strict=True):
            if count:
                found[bin_] += count
        return cls(found)

    @classmethod
    def together(cls, histograms: Iterable[Histogram]) -> Histogram:
        """Return the counts of all."""
        return cls(sum((one.counts for one in histograms), Counter()))

    @classmethod
    def from_plain(cls, plain: Mapping[str, int]) -> Histogram:
        """Return what `plain` gave."""
        return cls(Counter({int(bin_): count for bin_, count in plain.items()}))

    @property
    def plain(self) -> dict[str, int]:
        """The counts as JSON has them."""
        return {str(bin_): count for bin_, count in sorted(self.counts.items())}

    @property
    def total(self) -> int:
        """How many times it holds."""
        return self.counts.total()

    def quantile(self, share: float) -> float | None:
        """Return the time in us that this share does not exceed; None of nothing."""
        if not self.counts:
            return None
        bins = sorted(self.counts)
        reached = np.cumsum([self.counts[bin_] for bin_ in bins])
        return bins[int(np.searchsorted(reached, share * self.total))] / _BINS_A_US
