"""Sync log files to the disk, and look after them, in a background thread.

A disk that hangs holds up this thread, and not the recorder.
"""

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
from .lost_log import LostLog, find_loss

_MAX_QUEUED = 256
"""Queued files. More are left to the kernel, which writes them back within half a minute."""
_POLL_S = 0.01


class FsyncWorker:
    """Sync the current file every `interval_s`, and each closed file, in a thread of its own.

    The kernel reports a disk error only once, to the process that syncs: `failures` returns it.
    `found` returns what the jobs found: that the current file was deleted, moved or cut off.
    """

    def __init__(self, interval_s: float = 0.5) -> None:
        self._interval_s = interval_s
        self._jobs: queue.SimpleQueue[tuple[Path, Callable[[], object]]] = queue.SimpleQueue()
        self._found: deque[object] = deque(maxlen=_MAX_QUEUED)
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
        """Sync and examine the current file if the last time is `interval_s` ago."""
        if writer is None or not self.idle:
            return
        now_s = time.monotonic()
        if now_s - self._synced_s < self._interval_s:
            return
        path, size, grown = writer.path, writer.size, writer.size != self._size
        self._synced_s, self._size = now_s, size
        with suppress(OSError, ValueError):
            descriptor = os.dup(writer.fileno())
            self._enqueue(path, lambda: _examined(path, descriptor, size, grown))

    def sync_closed(self, path: Path) -> None:
        """Sync a closed file and its folder entry."""
        self._enqueue(path, lambda: _sync_paths(path, path.parent))

    def run(self, path: Path, job: Callable[[], object]) -> None:
        """Run a job for a file in the thread; `found` returns its result."""
        self._queued += 1
        self._jobs.put((path, job))

    def found(self) -> list[object]:
        """Return the results of jobs since the last call."""
        found = []
        while self._found:
            found.append(self._found.popleft())
        return found

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

    def _enqueue(self, path: Path, sync: Callable[[], object]) -> None:
        if self._queued - self._done < _MAX_QUEUED:
            self.run(path, sync)

    def _run(self) -> None:
        while True:
            path, job = self._jobs.get()
            try:
                if (found := job()) is not None:
                    self._found.append(found)
            except OSError as error:
                reason = f"{path}: cannot sync to the disk: {error.strerror or error}"
                if reason != self._last_failure:  # repeats every half second: report it once
                    self._failures.append((path, reason))
                self._last_failure = reason
            self._done += 1


def _examined(path: Path, descriptor: int, size: int, grown: bool) -> LostLog | None:
    """Sync an open file if it has grown; return what happened to it on the disk."""
    try:
        if grown:
            os.fdatasync(descriptor)
        return find_loss(path, descriptor, size)
    finally:
        os.close(descriptor)


def _sync_paths(*paths: Path) -> None:
    for path in paths:
        descriptor = os.open(path, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
