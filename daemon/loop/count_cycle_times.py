"""Count the times of a cycle in the histograms of timing_histograms, compiled for the loop."""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from ..ipc.timing_histograms import BINS, FINE, PARTS, POWERS, Time


def memory_of(period_ns: float) -> NDArray[np.float64]:
    """Return the initial `before` array of `account`; compiles `account`."""
    before = np.array([0.0, 0.0, period_ns, period_ns])
    account(np.zeros((len(Time) + 1, BINS), np.int64), 0.0, 0, 0, 0, 0, before)
    return before


@njit(cache=True)
def _bin(ns, parts):  # type: ignore[no-untyped-def]
    mantissa, power = math.frexp(max(ns, 1.0))
    return min(power * parts + int((mantissa - 0.5) * 2 * parts), POWERS * parts - 1)


@njit(cache=True)
def count_wake_up(counts, ns) -> None:  # type: ignore[no-untyped-def]
    """Count the delay of a wake-up in ns; ignore negative values (the loop did not sleep)."""
    if ns >= 0:
        counts[_bin(float(ns), FINE)] += 1
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
        counts[i, _bin(ns, PARTS)] += 1
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
