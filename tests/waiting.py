"""Wait for another thread or process: every wait is for a condition, and is bounded."""

from __future__ import annotations

import time
from collections.abc import Callable

_POLL_S = 0.002


def wait_until(condition: Callable[[], object], timeout_s: float = 10.0, what: str = "") -> None:
    """Poll `condition` until it is true; fail after `timeout_s`, far more than it can take."""
    give_up_s = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < give_up_s, f"not within {timeout_s:g} s: {what or condition}"
        time.sleep(_POLL_S)
