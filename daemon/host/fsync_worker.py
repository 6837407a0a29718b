"""Sync log files to the disk in a background thread, in case the power fails."""

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

_MAX_QUEUED = 256
"""Queued files. More are left to the kernel, which writes them back within half a minute."""
_POLL_S = 0.01


class FsyncWorker:
    """Sync the current file every `interval_s`, and each closed file, in a thread of its own.

    The kernel reports a disk error only once, to the process that syncs: `failures` returns it.
    """

    def __init__(self, interval_s: float = 0.5) -> None:
        self._interval_s = interval_s
        self._jobs: queue.SimpleQueue[tuple[Path, Callable[[], None]]] = queue.SimpleQueue()
        self._failures: deque[tuple[Path, str]] = deque(maxlen=_MAX_QUEUED)
        self._queued = self._done = 0
        self._synced_s, self._size = 0.0, 0
        self._last_failure = ""
        threading.Thread(target=self._run, name="levid-sync", daemon=True).start()

    @property
    def idle(self) -> bool:
        """Whether all queued syncs are done."""
        return self._done == self._queued

    def sync_growing(self, writer: LogWriter | None) -> None:
        """Sync the current file if it has grown and the last sync is `interval_s` ago."""
        if writer is None or writer.size == self._size or not self.idle:
            return
        now_s = time.monotonic()
        if now_s - self._synced_s < self._interval_s:
            return
        self._synced_s, self._size = now_s, writer.size
        with suppress(OSError, ValueError):
            descriptor = os.dup(writer.fileno())
            self._enqueue(writer.path, lambda: _sync(descriptor))

    def sync_closed(self, path: Path) -> None:
        """Sync a closed file and its folder entry."""
        self._enqueue(path, lambda: _sync_paths(path, path.parent))

    def failures(self) -> list[tuple[Path, str]]:
        """Return the files whose sync failed since the last call, with the reasons."""
        failures = []
        while self._failures:
            failures.append(self._failures.popleft())
        return failures

    def finish(self, timeout_s: float) -> None:
        """Wait until all syncs are done, at most `timeout_s`."""
        deadline_s = time.monotonic() + timeout_s
        while not self.idle and time.monotonic() < deadline_s:
            time.sleep(_POLL_S)

    def _enqueue(self, path: Path, sync: Callable[[], None]) -> None:
        if self._queued - self._done < _MAX_QUEUED:
            self._queued += 1
            self._jobs.put((path, sync))

    def _run(self) -> None:
        while True:
            path, sync = self._jobs.get()
            try:
                sync()
            except OSError as error:
                reason = f"{path}: cannot sync to the disk: {error.strerror or error}"
                if reason != self._last_failure:  # repeats every half second: report it once
                    self._failures.append((path, reason))
                self._last_failure = reason
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
