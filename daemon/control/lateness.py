"""When late cycles are too many: in a row, within a window, or all at once."""

from __future__ import annotations

from ...config.rig import Limits

_FORGIVEN = 0.1
"""What a cycle in time takes back of the late cycles that are counted against their limit."""
_PARTS = 10
"""The window moves on by a tenth of its length: it holds the last nine tenths at any time."""


class Lateness:
    """Counts late cycles against limits.late_cycles and late_in_window, and single stalls.

    `longest_stall`: periods in a row that may be skipped. `why` says which limit was exceeded.
    """

    def __init__(self, limits: Limits, rate_hz: float, longest_stall: int) -> None:
        self._most, self._longest, self._rate_hz = limits.late_cycles, longest_stall, rate_hz
        self._most_in_window = limits.late_in_window
        self._part = max(round(limits.late_window_s * rate_hz / _PARTS), 1)
        self.late = 0
        self.why = ""
        self._score = 0.0
        self._cycles = self._in_window = self._at = 0
        self._in_part = [0] * _PARTS

    def too_much(self, skipped: int) -> bool:
        """Count a cycle before which so many periods were skipped; return whether it is a fault."""
        self._cycles += 1 + skipped
        if self._cycles >= self._part:
            self._next_parts()
        if not skipped:
            if self._score > 0.0:
                self._score -= _FORGIVEN
            return False
        self.late += 1
        self._in_window += 1
        self._in_part[self._at] += 1
        self._score = min(self._score + 1.0, self._most + 1.0)
        if skipped > self._longest:
            stood_s, most_s = skipped / self._rate_hz, self._longest / self._rate_hz
            self.why = f"the loop stood still for {stood_s:.3g} s, at most {most_s:.3g} s may pass"
        elif self._score > self._most:
            self.why = f"more than {self._most} cycles in a row were late"
        elif self._in_window > self._most_in_window:
            self.why = f"{self._in_window} cycles were late within limits.late_window_s"
        else:
            return False
        return True

    def forget(self) -> None:
        """Begin anew after a fault."""
        self._score = 0.0
        self._cycles = self._in_window = 0
        self._in_part[:] = [0] * _PARTS

    def _next_parts(self) -> None:
        """Let go of what was late in the parts that the window leaves behind."""
        for _ in range(min(self._cycles // self._part, _PARTS)):
            self._at = (self._at + 1) % _PARTS
            self._in_window -= self._in_part[self._at]
            self._in_part[self._at] = 0
        self._cycles %= self._part
