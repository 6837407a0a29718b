"""Whether the machine's clock was set while the daemon runs; nothing in a flight depends on it."""

from __future__ import annotations

import time

_STEP_S = 0.1
"""Slewing changes the clock by 0.5 ms a second at most; between two looks that is far less."""


class ClockWatch:
    """Compares the time of day with the monotonic clock, which nobody can set."""

    def __init__(self) -> None:
        self._ahead_s = _ahead_s()
        self.stepped_s = 0.0
        """By how much the clock was set forward since the start, in s, all steps together."""

    def look(self) -> float:
        """Return the step since the last look, in s; 0 where there was none."""
        ahead_s = _ahead_s()
        step_s, self._ahead_s = ahead_s - self._ahead_s, ahead_s
        if abs(step_s) < _STEP_S:
            return 0.0
        self.stepped_s += step_s
        return step_s


def _ahead_s() -> float:
    return time.time() - time.monotonic()
