"""Detect too many late cycles: in a row, within a window, or in one stall."""

from __future__ import annotations

from ...config.rig import Limits

_RECOVERY = 0.1
"""Late cycles that one punctual cycle subtracts from the consecutive count."""
_PARTS = 10
"""Parts of the window. It advances by one part at a time: it always covers the last nine parts."""


class Lateness:
    """Count late cycles and compare them with limits.late_cycles, late_in_window and a stall limit.

    `longest_stall`: consecutive periods that may be skipped. `reason`: the exceeded limit, as text.
    """

    def __init__(self, limits: Limits, rate_hz: float, longest_stall: int) -> None:
        self._max_in_a_row, self._rate_hz = limits.late_cycles, rate_hz
        self._longest_stall = longest_stall
        self._max_in_window = limits.late_in_window
        self._part = max(round(limits.late_window_s * rate_hz / _PARTS), 1)
        self.late = 0
        self.reason = ""
        self._in_a_row = 0.0
        self._cycles = self._in_window = self._part_index = 0
        self._in_part = [0] * _PARTS

    def exceeded(self, skipped: int) -> bool:
        """Count a cycle that follows `skipped` periods; return whether a limit is exceeded."""
        self._cycles += 1 + skipped
        if self._cycles >= self._part:
            self._next_parts()
        if not skipped:
            if self._in_a_row > 0.0:
                self._in_a_row -= _RECOVERY
            return False
        self.late += 1
        self._in_window += 1
        self._in_part[self._part_index] += 1
        self._in_a_row = min(self._in_a_row + 1.0, self._max_in_a_row + 1.0)
        if skipped > self._longest_stall:
            stall_s, limit_s = skipped / self._rate_hz, self._longest_stall / self._rate_hz
            self.reason = f"the loop stalled for {stall_s:.3g} s, the limit is {limit_s:.3g} s"
        elif self._in_a_row > self._max_in_a_row:
            self.reason = f"more than {self._max_in_a_row} cycles in a row were late"
        elif self._in_window > self._max_in_window:
            self.reason = f"{self._in_window} cycles were late within limits.late_window_s"
        else:
            return False
        return True

    def reset(self) -> None:
        """Reset the counts that are compared with limits, as after a fault."""
        self._in_a_row = 0.0
        self._cycles = self._in_window = 0
        self._in_part[:] = [0] * _PARTS

    def _next_parts(self) -> None:
        """Advance the window; drop the late cycles of the parts that it leaves."""
        for _ in range(min(self._cycles // self._part, _PARTS)):
            self._part_index = (self._part_index + 1) % _PARTS
            self._in_window -= self._in_part[self._part_index]
            self._in_part[self._part_index] = 0
        self._cycles %= self._part
