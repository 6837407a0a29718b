"""Record a flight in virtual time in a thread, which the loop waits for."""

from __future__ import annotations

import threading
import time

from ..ipc.row_ring import Ring
from .log_router import BLOCK, LogFile, LogRouter

_POLL_S = 0.01


class Recorder:
    """Write the rows of `ring` to logs.

    `define` returns the tag for the rows of a log. A disk error stops recording, never the flight;
    `error` holds it.
    """

    def __init__(self, ring: Ring, rate_hz: float) -> None:
        self._ring = ring
        self._logs: dict[int, LogFile] = {}
        self._router = LogRouter(ring, rate_hz, self._logs.get)
        self._finish = threading.Event()
        self._finished = threading.Event()
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="levid-recorder", daemon=True)

    @property
    def error(self) -> Exception | None:
        """Error that ended the recording, None if there was none."""
        return self._router.error

    def start(self, epoch_ns: int) -> None:
        """Start reading rows; `epoch_ns` is the log time of cycle 0."""
        self._router.epoch_ns = epoch_ns
        self._thread.start()

    def forget_errors(self) -> None:
        """Resume recording after a failure, from the next log on."""
        self._router.forget_errors()

    def define(self, file: LogFile) -> int:
        """Return the tag for the rows of this log."""
        tag = len(self._logs) + 1
        self._logs[tag] = file
        return tag

    def close(self, *, cut_off: bool = False) -> None:
        """Write the remaining rows, close the file, stop the thread; safe to call twice.

        With `cut_off` the file is left without its end: it must not look whole.
        """
        if cut_off:
            self._router.cut_off()
        self._stop.set()
        if self._thread.is_alive():
            self._thread.join()

    def finish(self) -> None:
        """Wait until all rows are written, and close the current file."""
        self._finished.clear()
        self._finish.set()
        while self._thread.is_alive() and not self._finished.wait(_POLL_S):
            pass

    def wait_for_room(self, rows: int) -> None:
        """Wait until the ring has room for `rows`: virtual time is faster than the disk."""
        while self._ring.room < rows and self._thread.is_alive():
            time.sleep(0.0005)

    def _run(self) -> None:
        while True:
            ending, finishing = self._stop.is_set(), self._finish.is_set()
            if len(self._router.work().rows) == 0:
                if finishing or ending:
                    self._router.finish()
                if finishing:
                    self._finish.clear()
                    self._finished.set()
                if ending:
                    return
            if self._ring.waiting < BLOCK and not ending and not finishing:
                self._stop.wait(_POLL_S)
