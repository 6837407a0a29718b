"""Readings that do not come while nothing flies: no fault, so the journal is to say it."""

from __future__ import annotations

from collections.abc import Callable

_LOOK_S = 2.0
_LOOKS = 2
"""After so many looks in a row that found readings missing it is said."""
_MISSING = 0.5
"""Stale readings a period from which on they are missing; single ones come late on any bus."""
_QUIET_S = 60.0
"""One line in that time, at most, and one that they are back."""


class Silence:
    """Compares how far the counters of periods and of stale readings moved; nothing in here waits.

    In flight readings that are missing are a fault, which says more.
    """

    def __init__(self, say: Callable[[str], None]) -> None:
        self._say = say
        self._looked_s: float | None = None
        self._cycle = self._stale = self._looks = 0
        self._since_s, self._said_s = 0.0, -_QUIET_S
        self._told = False

    def look(self, now_s: float, cycle: int, stale: int, resting: bool) -> None:
        """Look, if it is time; `cycle` and `stale` count since the start."""
        if self._looked_s is not None and now_s - self._looked_s < _LOOK_S:
            return
        before_s, self._looked_s = self._looked_s, now_s
        cycles, stales = cycle - self._cycle, stale - self._stale
        self._cycle, self._stale = cycle, stale
        if before_s is None or cycles <= 0:  # devices are being opened, or the loop is dead
            return
        if stales <= _MISSING * cycles:
            self._looks = 0
            if self._told:
                self._told = False
                self._say(f"readings are back after {before_s - self._since_s:.0f} s")
            return
        if not self._looks:
            self._since_s = before_s
        self._looks += 1
        if not resting or self._told or self._looks < _LOOKS:
            return
        if now_s - self._said_s >= _QUIET_S:
            self._told, self._said_s = True, now_s
            self._say(
                f"readings have been missing for {now_s - self._since_s:.0f} s, at zero force: "
                f"{stales} of the last {cycles} periods; electronics without power, or a cable?"
            )
