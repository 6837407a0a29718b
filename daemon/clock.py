"""Two clocks for one loop: real time with absolute deadlines, and virtual time that never waits."""

from __future__ import annotations

import time
from typing import Protocol

VIRTUAL_EPOCH_NS = 1_577_836_800_000_000_000
"""Log time of cycle 0 in virtual time, 2020-01-01T00:00:00Z: the same run is the same bytes."""

_SPIN_NS = 50_000


class Clock(Protocol):
    """Paces the loop, one `wait` a cycle."""

    epoch_ns: int
    """Log time of cycle 0."""
    skipped: int
    """Whole periods that the last `wait` had to skip because the loop was late."""
    real: bool

    def start(self) -> None:
        """Begin cycle 0 now."""

    def wait(self) -> float:
        """Wait for the next cycle; return how late it begins, in s."""


class VirtualClock:
    """As fast as the code runs: never waits, never late."""

    real = False

    def __init__(self) -> None:
        self.epoch_ns = VIRTUAL_EPOCH_NS
        self.skipped = 0

    def start(self) -> None:
        """Nothing to start."""

    def wait(self) -> float:
        """Return 0.0 at once."""
        return 0.0


class RealClock:
    """Absolute deadlines on the monotonic clock; sleeps to 50 us before each, then spins.

    A cycle that is late by a period or more skips the periods it missed: the loop never bursts to
    catch up.
    """

    real = True

    def __init__(self, period_s: float) -> None:
        self._period_ns = round(period_s * 1e9)
        self._deadline_ns = 0
        self.epoch_ns = 0
        self.skipped = 0

    def start(self) -> None:
        """Begin cycle 0 at the next whole moment; deadlines follow from here."""
        self.epoch_ns = time.time_ns()
        self._deadline_ns = time.monotonic_ns() - self._period_ns

    def wait(self) -> float:
        """Sleep until the next deadline; return the lateness in s and set `skipped`."""
        deadline = self._deadline_ns + self._period_ns
        now = time.monotonic_ns()
        ahead = deadline - now - _SPIN_NS
        if ahead > 0:
            time.sleep(ahead * 1e-9)
            now = time.monotonic_ns()
        while now < deadline:
            now = time.monotonic_ns()
        late = now - deadline
        self.skipped = late // self._period_ns
        self._deadline_ns = deadline + self.skipped * self._period_ns
        return late * 1e-9
