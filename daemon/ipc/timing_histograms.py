"""Count cycle times and late cycles in histograms in shared memory, without allocation."""

from __future__ import annotations

import math
from collections.abc import Mapping
from enum import IntEnum
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

_POWERS = 40
_PARTS, _FINE = 4, 32
"""Bins per power of two: the error of a quantile is at most a quarter, mostly below an eighth.
Wake-up times are compared with cyclictest: their bins are at most 3 % wide."""
_BINS, _FINE_BINS = _POWERS * _PARTS, _POWERS * _FINE
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

    SIZE = 8 * (len(Time) + 1) * _BINS

    def __init__(self, memory: memoryview) -> None:
        self.counts: NDArray[np.int64] = np.frombuffer(
            memory, np.int64, (len(Time) + 1) * _BINS
        ).reshape(len(Time) + 1, _BINS)

    def figures(self) -> dict[str, Any]:
        """Return p50, p99, p99.9 and max of each time in us, and the late cycles by cause."""
        counts = self.counts.copy()
        facts = counts[-1]
        found: dict[str, Any] = {
            f"{time.name.lower()}_us": _quantiles(counts[time], int(facts[time]), _PARTS)
            for time in Time
        }
        found["late_by"] = {cause.name.lower(): int(facts[len(Time) + cause]) for cause in LateBy}
        return found

    def clear(self) -> None:
        """Reset all counts."""
        self.counts[:] = 0


def memory_of(period_ns: float) -> NDArray[np.float64]:
    """Return the initial `before` array of `account`; compiles `account`."""
    before = np.array([0.0, 0.0, period_ns, period_ns])
    account(np.zeros((len(Time) + 1, _BINS), np.int64), 0.0, 0, 0, 0, 0, before)
    return before


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
        return _quantiles(counts[:-1], int(counts[-1]), _FINE)

    @staticmethod
    def edges_us() -> NDArray[np.float64]:
        """Return the lower edges of the bins in us (bins,)."""
        return np.array([_edge_ns(bin_ - 1, _FINE) for bin_ in range(_FINE_BINS)]) * 1e-3


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


@njit(cache=True)
def _bin(ns, parts):  # type: ignore[no-untyped-def]
    mantissa, power = math.frexp(max(ns, 1.0))
    return min(power * parts + int((mantissa - 0.5) * 2 * parts), _POWERS * parts - 1)


@njit(cache=True)
def count_wake_up(counts, ns) -> None:  # type: ignore[no-untyped-def]
    """Count the delay of a wake-up in ns; ignore negative values (the loop did not sleep)."""
    if ns >= 0:
        counts[_bin(float(ns), _FINE)] += 1
        counts[-1] = max(counts[-1], ns)


@njit(cache=True)
def account(counts, late, drivers, control, writing, skipped, before) -> None:  # type: ignore[no-untyped-def]
    """Count the times of one cycle in ns.

    late: delay from the deadline, skipped periods included. `before` (4,) passes on to the next
    cycle: driver time, other time, remaining time of the period, period. The cause of a late cycle
    is the longer part of the previous cycle, or the wake-up if that cycle ended in time.
    """
    facts = counts[-1]
    times = float(late), float(drivers), float(control), float(writing)
    execution = times[1] + times[2] + times[3]
    for i, ns in enumerate((*times, execution)):
        counts[i, _bin(ns, _PARTS)] += 1
        facts[i] = max(facts[i], int(ns))
    if skipped > 0:
        if before[0] + before[1] < before[2]:
            facts[5] += 1
        elif before[0] > before[1]:
            facts[6] += 1
        else:
            facts[7] += 1
    before[0], before[1] = drivers + writing, control
    before[2] = (1 + skipped) * before[3] - late  # the cycle started in the last skipped period
