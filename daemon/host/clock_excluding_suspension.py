"""Clock that excludes the time the whole machine was suspended."""

from __future__ import annotations

_MAX_STEP_S = 0.1


class ProcessClock:
    """Sum the times between calls of `update`, at most 0.1 s each.

    A watchdog calls it much more often. If calls are further apart, this process did not run, and
    the monitored processes may not have run either.
    """

    def __init__(self) -> None:
        self._updated_s: float | None = None
        self._passed_s = 0.0

    def update(self, now_s: float) -> float:
        """Return the running time of this process, s; `now_s` is the monotonic clock."""
        if self._updated_s is not None:
            self._passed_s += min(now_s - self._updated_s, _MAX_STEP_S)
        self._updated_s = now_s
        return self._passed_s
