"""Keep the newest journal lines for the status."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import Any

_EVENTS = 12
_LONGEST = 240


class RecentEvents:
    """Pass journal lines on to `log` and keep the newest; call from one thread, read from any."""

    def __init__(self, log: Callable[[str], None]) -> None:
        self._log = log
        self._latest: tuple[dict[str, Any], ...] = ()

    def __call__(self, line: str) -> None:
        """Log a line and keep its beginning."""
        event = {"time_s": round(time.time(), 3), "text": line[:_LONGEST]}
        # A new tuple: the server's thread may be reading the present one.
        self._latest = (*self._latest[1 - _EVENTS :], event)
        self._log(line)

    @property
    def latest(self) -> Sequence[dict[str, Any]]:
        """Newest lines, oldest first: `time_s` (seconds since 1970, UTC) and `text`."""
        return self._latest
