"""Time as this process lived it: a machine that stood still did so for whom it watches too."""

from __future__ import annotations

_MOST_AT_ONCE_S = 0.1


class Awake:
    """Adds up the time between two looks, 0.1 s at most of each.

    Whoever watches others looks much more often than that. Between two looks that are further apart
    he was not there, and cannot say that they were.
    """

    def __init__(self) -> None:
        self._looked_s: float | None = None
        self._passed_s = 0.0

    def look(self, now_s: float) -> float:
        """Return how long this process has been awake, s; `now_s` is on the monotonic clock."""
        if self._looked_s is not None:
            self._passed_s += min(now_s - self._looked_s, _MOST_AT_ONCE_S)
        self._looked_s = now_s
        return self._passed_s
