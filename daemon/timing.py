"""Histograms of the loop's times in shared memory: filled in a cycle without allocating."""

from __future__ import annotations

import math
from collections.abc import Mapping
from enum import IntEnum
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

_PARTS = 4
"""Bins of one power of two: a quantile is right to a quarter, and mostly to an eighth."""
_BINS = 40 * _PARTS
SHARES = {"p50": 0.5, "p99": 0.99, "p99.9": 0.999}


class Time(IntEnum):
    """What is measured of a cycle."""

    LATENESS = 0  # from the deadline to the cycle's begin
    DRIVERS = 1  # sync and readings
    CONTROL = 2  # choosing what to fly, control, its row of the log
    WRITING = 3  # setpoints
    EXECUTION = 4  # all of it


class LateBy(IntEnum):
    """Why a cycle was late by a period or more."""

    WAKE_UP = 0  # the kernel woke the loop too late
    DRIVERS = 1  # devices took too long in the cycle before, read or written
    CONTROL = 2  # everything else in the cycle before did


class Timing:
    """Counts (times, bins) and a last row: maxima in ns, then late cycles by their cause."""

    SIZE = 8 * (len(Time) + 1) * _BINS

    def __init__(self, memory: memoryview) -> None:
        self.counts: NDArray[np.int64] = np.frombuffer(
            memory, np.int64, (len(Time) + 1) * _BINS
        ).reshape(len(Time) + 1, _BINS)

    def figures(self) -> dict[str, Any]:
        """Return by name p50, p99, p99.9 and max in us, and the number of late cycles by cause."""
        counts = self.counts.copy()
        facts = counts[-1]
        found: dict[str, Any] = {
            f"{time.name.lower()}_us": _quantiles(counts[time], int(facts[time])) for time in Time
        }
        found["late_by"] = {cause.name.lower(): int(facts[len(Time) + cause]) for cause in LateBy}
        return found

    def clear(self) -> None:
        """Begin anew."""
        self.counts[:] = 0


def memory_of(period_ns: float) -> NDArray[np.float64]:
    """Return what `account` keeps of a cycle, before the first; compiles it."""
    before = np.array([0.0, 0.0, period_ns, period_ns])
    account(np.zeros((len(Time) + 1, _BINS), np.int64), 0.0, 0, 0, 0, 0, before)
    return before


def _quantiles(counts: NDArray[np.int64], largest_ns: int) -> Mapping[str, float]:
    total = int(counts.sum())
    if not total:
        return dict.fromkeys([*SHARES, "max"], 0.0)
    reached = np.cumsum(counts)
    found = {
        # The upper edge of the bin, and never more than the largest.
        name: min(float(_edge_ns(int(np.searchsorted(reached, share * total)))), largest_ns) * 1e-3
        for name, share in SHARES.items()
    }
    return {**found, "max": largest_ns * 1e-3}


def _edge_ns(bin_: int) -> float:
    power, part = divmod(bin_, _PARTS)
    return 2.0**power * (0.5 + 0.5 * (part + 1) / _PARTS)


@njit(cache=True)
def account(counts, late, drivers, control, writing, skipped, before) -> None:  # type: ignore[no-untyped-def]
    """Count one cycle's times in ns.

    late: from its deadline, skipped periods included. `before` (4,) keeps of it what the next one
    needs: times of drivers and of the rest, what it had left of its period, and the period. A cycle
    that was late is put down to what the one before it spent its time on, or where that had ended
    in time, to the wake-up.
    """
    facts = counts[-1]
    times = float(late), float(drivers), float(control), float(writing)
    execution = times[1] + times[2] + times[3]
    for i, ns in enumerate((*times, execution)):
        mantissa, power = math.frexp(max(ns, 1.0))
        bin_ = min(power * _PARTS + int((mantissa - 0.5) * 2 * _PARTS), _BINS - 1)
        counts[i, bin_] += 1
        facts[i] = max(facts[i], int(ns))
    if skipped > 0:
        if before[0] + before[1] < before[2]:
            facts[5] += 1
        elif before[0] > before[1]:
            facts[6] += 1
        else:
            facts[7] += 1
    before[0], before[1] = drivers + writing, control
    before[2] = (1 + skipped) * before[3] - late  # it began in the last of the periods it missed
