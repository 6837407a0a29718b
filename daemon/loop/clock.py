"""Two clocks for one loop: real time with absolute deadlines, and virtual time that never waits."""

from __future__ import annotations

import time
from typing import Protocol

VIRTUAL_EPOCH_NS = 1_577_836_800_000_000_000
"""Log time of cycle 0 in virtual time, 2020-01-01T00:00:00Z: the same run is the same bytes."""

_SPIN_NS, _SPIN_SHARE = 50_000, 5


class Clock(Protocol):
    """Paces the loop, one `wait` a cycle."""

    epoch_ns: int
    """Log time of cycle 0."""
    skipped: int
    """Whole periods that the last `wait` had to skip because the loop was late."""
    overslept_ns: int
    """How long after the moment that it had asked for the last `wait` woke up, before it spun;
    negative where it did not sleep."""
    real: bool

    def start(self) -> None:
        """Begin cycle 0 now."""

    def wait(self) -> float:
        """Wait for the next cycle; return how late it begins, in s, skipped periods included."""


class VirtualClock:
    """As fast as the code runs: never waits, never late."""

    real = False

    def __init__(self) -> None:
        self.epoch_ns = VIRTUAL_EPOCH_NS
        self.skipped = 0
        self.overslept_ns = -1

    def start(self) -> None:
        """Nothing to start."""

    def wait(self) -> float:
        """Return 0.0 at once."""
        return 0.0


class RealClock:
    """Absolute deadlines on the monotonic clock; sleeps to 50 us before each, then spins.

    A period of less than 250 us is spun for a fifth of at most: the kernel stops what never sleeps.

    A cycle that is late by a period or more skips the periods it missed: the loop never bursts to
    catch up.
    """

    real = True

    def __init__(self, period_s: float) -> None:
        self._period_ns = period_s * 1e9
        self._spin_ns = round(min(_SPIN_NS, self._period_ns / _SPIN_SHARE))
        self._start_ns = self._cycle = 0
        self.epoch_ns = 0
        self.skipped = 0
        self.overslept_ns = -1

    def start(self) -> None:
        """Begin cycle 0 at the next whole moment; deadlines follow from here."""
        self.epoch_ns = time.time_ns()
        self._start_ns, self._cycle = time.monotonic_ns(), -1

    def wait(self) -> float:
        """Sleep until the next deadline; return the lateness in s and set `skipped`."""
        # From the first cycle on: a period may be no whole number of ns, and days have many.
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
