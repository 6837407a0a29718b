"""Clocks of the loop: real time with absolute deadlines, and virtual time without waiting."""

from __future__ import annotations

import time
from typing import Protocol

from ...log.log_facts import VIRTUAL_EPOCH_NS

_SPIN_NS, _MIN_PERIOD_OVER_SPIN = 50_000, 5


class Clock(Protocol):
    """Pace the loop, one `wait` per cycle."""

    epoch_ns: int
    """Log time of cycle 0."""
    skipped: int
    """Whole periods that the last `wait` skipped because the loop was late."""
    overslept_ns: int
    """Delay of the last wake-up relative to the requested time, before spinning; negative without
    sleep."""
    real: bool

    def start(self) -> None:
        """Start; the first `wait` returns at cycle 0."""

    def wait(self) -> float:
        """Wait for the next cycle; return its lateness in s, skipped periods included."""


class VirtualClock:
    """Run as fast as the code: never waits, never late."""

    real = False

    def __init__(self) -> None:
        self.epoch_ns = VIRTUAL_EPOCH_NS
        self.skipped = 0
        self.overslept_ns = -1

    def start(self) -> None:
        """Do nothing."""

    def wait(self) -> float:
        """Return 0.0 at once."""
        return 0.0


class RealClock:
    """Wait for absolute deadlines on the monotonic clock: sleep until 50 us before, then spin.

    It spins for a fifth of the period at most: the kernel throttles real-time processes that never
    sleep. A cycle that is late by a period or more skips the missed periods; the loop never catches
    up in a burst.
    """

    real = True

    def __init__(self, period_s: float) -> None:
        self._period_ns = period_s * 1e9
        self._spin_ns = round(min(_SPIN_NS, self._period_ns / _MIN_PERIOD_OVER_SPIN))
        self._start_ns = self._cycle = 0
        self.epoch_ns = 0
        self.skipped = 0
        self.overslept_ns = -1

    def start(self) -> None:
        """Start now: all deadlines follow from this time."""
        self.epoch_ns = time.time_ns()
        self._start_ns, self._cycle = time.monotonic_ns(), -1

    def wait(self) -> float:
        """Sleep until the next deadline; return the lateness in s and set `skipped`."""
        # Computed from the start: the rounding of a period to ns would add up over days.
        deadline = self._start_ns + round((self._cycle + 1) * self._period_ns)
        wake = deadline - self._spin_ns
        now = time.monotonic_ns()
        if now < wake:
            time.sleep((wake - now) * 1e-9)
            now = time.monotonic_ns()
            self.overslept_ns = now - wake
        else:
            self.overslept_ns = -1
        while now < deadline:
            now = time.monotonic_ns()
        late = now - deadline
        self.skipped = int(late // self._period_ns)
        self._cycle += 1 + self.skipped
        return late * 1e-9
