"""The recorder: takes rows from the ring in a thread of its own and writes one MCAP file a step."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..log.writer import LogWriter
from .ring import Ring

_BLOCK = 8192
_POLL_S = 0.01


@dataclass(frozen=True)
class LogFile:
    """A log to begin: where it lies and what stands at its head."""

    path: Path
    metadata: Mapping[str, str]
    attachments: Mapping[str, bytes]


class Recorder:
    """Writes what the loop leaves in `ring`.

    `open` and `shut` are called between segments and take effect at that very row; rows outside
    any file are dropped. A failure of the disk stops recording, never the flight: it is kept in
    `error`.
    """

    def __init__(self, ring: Ring, rate_hz: float) -> None:
        self._ring, self._rate_hz = ring, rate_hz
        self._period_ns = 1e9 / rate_hz
        self.epoch_ns = 0
        self.error: Exception | None = None
        self._marks: deque[tuple[int, LogFile | None]] = deque()
        self._writer: LogWriter | None = None
        self._busy = False
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="levid-recorder", daemon=True)

    def start(self, epoch_ns: int) -> None:
        """Begin to take rows; `epoch_ns` is the log time of cycle 0."""
        self.epoch_ns = epoch_ns
        self._thread.start()

    def forget_errors(self) -> None:
        """Begin anew after a failure: the next session records again."""
        self.error = None

    def open(self, file: LogFile) -> None:
        """Write rows from here on into a new file."""
        self._marks.append((self._ring.head, file))

    def shut(self) -> None:
        """End the file at hand here."""
        self._marks.append((self._ring.head, None))

    def close(self) -> None:
        """Write what is left, end the file, stop the thread; safe to call twice."""
        self.shut()
        self._stop.set()
        if self._thread.is_alive():
            self._thread.join()

    def settle(self) -> None:
        """Wait until everything that was recorded so far is in its file."""
        while (self._ring.waiting or self._marks or self._busy) and self._thread.is_alive():
            time.sleep(0.001)

    def wait_for_room(self, rows: int) -> None:
        """Wait until the ring has room for `rows`; for virtual time, which outruns any disk."""
        while self._ring.room < rows and self._thread.is_alive():
            time.sleep(0.0005)

    def _run(self) -> None:
        while True:
            ending = self._stop.is_set()
            if not self._drain() and ending:
                return
            if self._ring.waiting < _BLOCK and not ending:
                self._stop.wait(_POLL_S)

    def _drain(self) -> bool:
        """Do one piece of work; return whether there was any."""
        self._busy = True
        try:
            return self._work()
        finally:
            self._busy = False

    def _work(self) -> bool:
        ring = self._ring
        head = ring.head  # before the marks: a mark that comes after it lies at or behind it
        if self._marks and ring.tail >= self._marks[0][0]:
            _, file = self._marks.popleft()
            self._guard(lambda: self._switch(file))
            return True
        up_to = self._marks[0][0] if self._marks else head
        if ring.tail >= up_to:
            return False
        rows = ring.take(up_to, _BLOCK)
        if self._writer is not None:
            times = self.epoch_ns + np.rint(rows["cycle"] * self._period_ns).astype(np.uint64)
            writer = self._writer
            self._guard(lambda: writer.write(rows, times))
        return True

    def _switch(self, file: LogFile | None) -> None:
        writer, self._writer = self._writer, None
        if writer is not None:
            writer.close()
        if file is not None and self.error is None:
            self._writer = LogWriter(
                file.path,
                self._ring.rows.dtype,
                rate_hz=self._rate_hz,
                metadata=file.metadata,
                attachments=file.attachments,
            )

    def _guard(self, action: Callable[[], None]) -> None:
        try:
            action()
        except Exception as error:  # noqa: BLE001 - kept in `error`, the flight goes on
            self.error = self.error or error
            self._writer = None
