"""How late the kernel wakes the loop up, before it spins: a histogram in shared memory.

What lateness says of a cycle is after the spin, which hides a wake-up that is late by less. This is
what cyclictest measures, and its bins are narrow enough to be held against it.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from .timing import SHARES

_PARTS = 32
"""Bins of one power of two: each is three hundredths wide at most."""
_BINS = 40 * _PARTS


class WakeUps:
    """Counts (bins + 1,): how often the loop woke up so late; the last one is the maximum in ns."""

    SIZE = 8 * (_BINS + 1)

    def __init__(self, memory: memoryview) -> None:
        self.counts: NDArray[np.int64] = np.frombuffer(memory, np.int64, _BINS + 1)

    def figures(self) -> dict[str, float]:
        """Return p50, p99, p99.9 and max in us; 0 where nothing was counted."""
        counts = self.counts.copy()
        reached, largest_us = np.cumsum(counts[:-1]), float(counts[-1]) * 1e-3
        if not reached[-1]:
            return dict.fromkeys([*SHARES, "max"], 0.0)
        upper_us = np.append(edges_us()[1:], math.inf)
        found = {
            name: min(float(upper_us[np.searchsorted(reached, share * reached[-1])]), largest_us)
            for name, share in SHARES.items()
        }
        return {**found, "max": largest_us}


def edges_us() -> NDArray[np.float64]:
    """Return the lower edge of each bin in us."""
    power, part = np.divmod(np.arange(_BINS), _PARTS)
    return np.asarray(2.0**power * (0.5 + 0.5 * part / _PARTS) * 1e-3)


@njit(cache=True)
def count_wake_up(counts, ns) -> None:  # type: ignore[no-untyped-def]
    """Count how late one wake-up was; negative where the loop did not sleep, which counts not."""
    if ns < 0:
        return
    mantissa, power = math.frexp(max(float(ns), 1.0))
    counts[min(power * _PARTS + int((mantissa - 0.5) * 2 * _PARTS), _BINS - 1)] += 1
    counts[-1] = max(counts[-1], ns)
