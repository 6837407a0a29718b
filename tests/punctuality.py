"""How punctual the machine was while a test ran: one that gave nobody its time proves nothing."""

from __future__ import annotations

import threading
import time

PERIOD_S = 0.01
_LATE_S = 0.005
_MOST_LATE_SHARE = 0.05
_LONGEST_S = 0.1


class Witness:
    """A thread that only wakes up, a hundred times a second, and notes how late it was."""

    def __init__(self) -> None:
        self._done = threading.Event()
        self._wakes = self._late = 0
        self._worst_s = 0.0
        self._thread = threading.Thread(target=self._run, daemon=True)

    def __enter__(self) -> Witness:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._done.set()
        self._thread.join()

    @property
    def starved(self) -> str:
        """What was wrong with the machine, in words; nothing where it was punctual."""
        share = self._late / max(self._wakes, 1)
        if share <= _MOST_LATE_SHARE and self._worst_s <= _LONGEST_S:
            return ""
        return (
            f"the machine was too busy: {share:.0%} of wake-ups were {1e3 * _LATE_S:g} ms late or "
            f"more, one {1e3 * self._worst_s:.0f} ms"
        )

    def _run(self) -> None:
        due_s = time.monotonic()
        while not self._done.is_set():
            due_s += PERIOD_S
            time.sleep(max(due_s - time.monotonic(), 0.0))
            late_s = time.monotonic() - due_s
            self._wakes += 1
            self._late += late_s > _LATE_S
            self._worst_s = max(self._worst_s, late_s)
            due_s = max(due_s, time.monotonic() - PERIOD_S)
