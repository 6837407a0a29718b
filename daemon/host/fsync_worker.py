"""Brings what was written to the disk itself, for the power may fail; nobody waits for it."""

from __future__ import annotations

import os
import queue
import threading
import time
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from ...log.writer import LogWriter

_EVERY_S = 0.5
_MOST_WAITING = 256
"""Files: what is more is left to the kernel, which writes back within half a minute."""
_POLL_S = 0.01


class Syncer:
    """Syncs the file at hand now and then, and every file that is whole, in a thread of its own.

    A disk that refuses says so once, to whoever syncs: `failures` has it.
    """

    def __init__(self) -> None:
        self._jobs: queue.SimpleQueue[tuple[Path, Callable[[], None]]] = queue.SimpleQueue()
        self._failures: deque[tuple[Path, str]] = deque(maxlen=_MOST_WAITING)
        self._asked = self._done = 0
        self._synced_s, self._size = 0.0, 0
        self._last = ""
        threading.Thread(target=self._run, name="levid-sync", daemon=True).start()

    @property
    def idle(self) -> bool:
        """Whether all that was asked for is done."""
        return self._done == self._asked

    def offer(self, writer: LogWriter | None) -> None:
        """Sync the file at hand if it has grown and the last time is long enough ago."""
        if writer is None or writer.size == self._size or not self.idle:
            return
        now_s = time.monotonic()
        if now_s - self._synced_s < _EVERY_S:
            return
        self._synced_s, self._size = now_s, writer.size
        with suppress(OSError, ValueError):
            descriptor = os.dup(writer.fileno())
            self._ask(writer.path, lambda: _sync(descriptor))

    def whole(self, path: Path) -> None:
        """Sync a file that is closed, and its name in its folder."""
        self._ask(path, lambda: _sync_paths(path, path.parent))

    def failures(self) -> list[tuple[Path, str]]:
        """Return what could not be brought to the disk since the last call, and why."""
        found = []
        while self._failures:
            found.append(self._failures.popleft())
        return found

    def finish(self, patience_s: float) -> None:
        """Wait until all is done, so long at most."""
        give_up_s = time.monotonic() + patience_s
        while not self.idle and time.monotonic() < give_up_s:
            time.sleep(_POLL_S)

    def _ask(self, path: Path, sync: Callable[[], None]) -> None:
        if self._asked - self._done < _MOST_WAITING:
            self._asked += 1
            self._jobs.put((path, sync))

    def _run(self) -> None:
        while True:
            path, sync = self._jobs.get()
            try:
                sync()
            except OSError as error:
                why = f"{path}: not on the disk: {error.strerror or error}"
                if why != self._last:  # else it was told, and comes every half second
                    self._failures.append((path, why))
                self._last = why
            self._done += 1


def _sync(descriptor: int) -> None:
    try:
        os.fdatasync(descriptor)
    finally:
        os.close(descriptor)


def _sync_paths(*paths: Path) -> None:
    for path in paths:
        descriptor = os.open(path, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
