"""Detect that the machine's clock was set while the daemon runs; flights do not depend on it."""

from __future__ import annotations

import time

_STEP_S = 0.1
"""Smallest change that counts as a step. Slewing (0.5 ms per second) stays far below it."""


class ClockWatch:
    """Compare the time of day with the monotonic clock, which cannot be set."""

    def __init__(self) -> None:
        self._ahead_s = _ahead_s()
        self.stepped_s = 0.0
        """Sum of all clock steps since the start, in s."""

    def poll(self) -> float:
        """Return the clock step since the last call, in s; 0 if none."""
        ahead_s = _ahead_s()
        step_s, self._ahead_s = ahead_s - self._ahead_s, ahead_s
        if abs(step_s) < _STEP_S:
            return 0.0
        self.stepped_s += step_s
        return step_s


def _ahead_s() -> float:
    return time.time() - time.monotonic()
