"""Log missing readings at zero force, where they are no fault."""

from __future__ import annotations

from collections.abc import Callable

_POLL_S = 2.0
_POLLS = 2
"""Consecutive polls with missing readings before they are logged."""
_MISSING = 0.5
"""Smallest fraction of stale cycles that counts as missing; single ones occur on any bus."""
_REPEAT_S = 60.0
"""Shortest time between two lines about missing readings."""


class StaleMonitor:
    """Compare the counters of cycles and stale cycles; log the start and end of missing readings.

    In flight, missing readings are a fault, which has its own message.
    """

    def __init__(self, log: Callable[[str], None]) -> None:
        self._log = log
        self._polled_s: float | None = None
        self._cycle = self._stale = self._polls = 0
        self._since_s, self._logged_s = 0.0, -_REPEAT_S
        self._reported = False

    def poll(self, now_s: float, cycle: int, stale: int, resting: bool) -> None:
        """Compare if the polling interval has passed; `cycle`, `stale` count since the start."""
        if self._polled_s is not None and now_s - self._polled_s < _POLL_S:
            return
        before_s, self._polled_s = self._polled_s, now_s
        cycles, stales = cycle - self._cycle, stale - self._stale
        self._cycle, self._stale = cycle, stale
        if before_s is None or cycles <= 0:  # devices are being opened, or the loop is dead
            return
        if stales <= _MISSING * cycles:
            self._polls = 0
            if self._reported:
                self._reported = False
                self._log(f"readings are back after {before_s - self._since_s:.0f} s")
            return
        if not self._polls:
            self._since_s = before_s
        self._polls += 1
        if not resting or self._reported or self._polls < _POLLS:
            return
        if now_s - self._logged_s >= _REPEAT_S:
            self._reported, self._logged_s = True, now_s
            self._log(
                f"readings have been missing for {now_s - self._since_s:.0f} s, at zero force: "
                f"{stales} of the last {cycles} periods; check power and cables of the electronics"
            )
