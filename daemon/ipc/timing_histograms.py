"""Count cycle times and late cycles in histograms in shared memory, without allocation."""

from __future__ import annotations

from collections.abc import Mapping
from enum import IntEnum
from typing import Any

import numpy as np
from numpy.typing import NDArray

POWERS = 40
PARTS, FINE = 4, 32
"""Bins per power of two: the error of a quantile is at most a quarter, mostly below an eighth.
Wake-up times are compared with cyclictest: their bins are at most 3 % wide."""
BINS, _FINE_BINS = POWERS * PARTS, POWERS * FINE
_SHARES = {"p50": 0.5, "p99": 0.99, "p99.9": 0.999}


class Time(IntEnum):
    """Number the measured times of a cycle."""

    LATENESS = 0  # from the deadline to the start of the cycle
    DRIVERS = 1  # sync and reading
    CONTROL = 2  # state machine, control law, log row
    WRITING = 3  # sending forces and setpoints
    EXECUTION = 4  # sum of the last three


class LateBy(IntEnum):
    """Number the causes of a cycle that is late by a period or more."""

    WAKE_UP = 0  # the kernel woke the loop too late
    DRIVERS = 1  # reading and writing devices took most of the previous cycle
    CONTROL = 2  # all else took most of the previous cycle


class Timing:
    """Hold counts (times, bins) and a last row: maxima in ns, then late cycles by cause."""

    SIZE = 8 * (len(Time) + 1) * BINS

    def __init__(self, memory: memoryview) -> None:
        self.counts: NDArray[np.int64] = np.frombuffer(
            memory, np.int64, (len(Time) + 1) * BINS
        ).reshape(len(Time) + 1, BINS)

    def figures(self) -> dict[str, Any]:
        """Return p50, p99, p99.9 and max of each time in us, and the late cycles by cause."""
        counts = self.counts.copy()
        facts = counts[-1]
        found: dict[str, Any] = {
            f"{time.name.lower()}_us": _quantiles(counts[time], int(facts[time]), PARTS)
            for time in Time
        }
        found["late_by"] = {cause.name.lower(): int(facts[len(Time) + cause]) for cause in LateBy}
        return found

    def clear(self) -> None:
        """Reset all counts."""
        self.counts[:] = 0


class WakeUps:
    """Count how late the kernel wakes the loop, which the lateness hides since the loop then spins.

    Counts (bins + 1,); the last element is the maximum in ns.
    """

    SIZE = 8 * (_FINE_BINS + 1)

    def __init__(self, memory: memoryview) -> None:
        self.counts: NDArray[np.int64] = np.frombuffer(memory, np.int64, _FINE_BINS + 1)

    def figures(self) -> Mapping[str, float]:
        """Return p50, p99, p99.9 and max in us; 0 without counts."""
        counts = self.counts.copy()
        return _quantiles(counts[:-1], int(counts[-1]), FINE)

    @staticmethod
    def edges_us() -> NDArray[np.float64]:
        """Return the lower edges of the bins in us (bins,)."""
        return np.array([_edge_ns(bin_ - 1, FINE) for bin_ in range(_FINE_BINS)]) * 1e-3


def _quantiles(counts: NDArray[np.int64], largest_ns: int, parts: int) -> Mapping[str, float]:
    total = int(counts.sum())
    if not total:
        return dict.fromkeys([*_SHARES, "max"], 0.0)
    reached = np.cumsum(counts)

    def quantile_ns(share: float) -> float:
        """Return the upper edge of the quantile's bin, at most the maximum."""
        return min(_edge_ns(int(np.searchsorted(reached, share * total)), parts), largest_ns)

    found = {name: quantile_ns(share) * 1e-3 for name, share in _SHARES.items()}
    return {**found, "max": largest_ns * 1e-3}


def _edge_ns(bin_: int, parts: int) -> float:
    power, part = divmod(bin_, parts)
    return float(2.0**power * (0.5 + 0.5 * (part + 1) / parts))
