"""Compare the rows that the loop wrote in flight with the rows in the logs.

The ring of rows is read from outside, in the shared memory of the daemon's processes. The cycle of
a row identifies it, wherever it is lost.
"""

from __future__ import annotations

import contextlib
import os
import time
from collections.abc import Iterable
from dataclasses import astuple, dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from levid.config.rig import load_rig
from levid.daemon.ipc.row_ring import NO_LOG
from levid.daemon.ipc.shared_memory import SharedMemory
from levid.daemon.ipc.shared_status_words import Word
from levid.log.reader import read_log

Cycles = NDArray[np.int64]

_WRITTEN_S = 120.0
"""Timeout for a busy disk; the daemon itself waits for a minute."""


class Flown:
    """Collect the rows of a flight from now on; call `look` every few seconds."""

    def __init__(self, supervisor: int, rig_file: Path) -> None:
        self._shared = SharedMemory(load_rig(rig_file), memory_of(supervisor))
        self._shared.close()  # the mapping stays
        self._ring, self.control_words = self._shared.ring, self._shared.control_words
        self._next = self._ring.head
        self._woken_before = self._shared.wake_ups.counts[:-1].copy()
        self._cycles: list[Cycles] = []
        self.lags: list[int] = []  # rows that waited for the recorder, at each look

    @property
    def cycles(self) -> Cycles:
        """The cycles whose rows belong in a log."""
        return np.concatenate([np.empty(0, np.int64), *self._cycles])

    @property
    def woken(self) -> Cycles:
        """Wake-ups of the loop, counted by the bins of `WakeUps`."""
        return self._shared.wake_ups.counts[:-1] - self._woken_before

    def look(self) -> None:
        """Read the new rows; raises RuntimeError if the loop has overwritten some."""
        ring = self._ring
        self.lags.append(ring.waiting)
        head = ring.head
        places = np.arange(self._next, head) % ring.capacity
        logged = ring.tags[places] != NO_LOG
        self._cycles.append(ring.rows["cycle"][places][logged].astype(np.int64))
        if ring.head - ring.capacity >= self._next:
            raise RuntimeError("the ring was read too late: the loop has overwritten rows")
        self._next = head

    def wait_until_written(self) -> None:
        """Wait until all rows are in their files; raises RuntimeError on a timeout."""
        self.look()
        ring, control_words = self._ring, self.control_words
        give_up_s = time.monotonic() + _WRITTEN_S
        while ring.durable < self._next or control_words[Word.WRITING] != NO_LOG:
            if time.monotonic() > give_up_s:
                raise RuntimeError(f"rows are not in their files after {_WRITTEN_S:g} s")
            time.sleep(0.02)


@dataclass(frozen=True)
class Found:
    """Errors in the logs of a flight: rows missing, twice or never flown, and truncated logs."""

    missing: int = 0
    duplicates: int = 0
    foreign: int = 0
    cut: int = 0

    @property
    def wrong(self) -> int:
        """Sum of all errors."""
        return sum(astuple(self))

    def __add__(self, other: Found) -> Found:
        return Found(*(a + b for a, b in zip(astuple(self), astuple(other), strict=True)))


def compare(flown: Cycles, logs: Iterable[Path]) -> Found:
    """Compare the flown cycles with the logs of the flight, in any order."""
    read = [read_log(path) for path in logs]
    cycles = [log.rows["cycle"].astype(np.int64) for log in read]
    cut = sum(not log.complete for log in read)
    return found_in(flown, np.concatenate([np.empty(0, np.int64), *cycles]), cut)


def found_in(flown: Cycles, logged: Cycles, cut: int) -> Found:
    """Compare the flown cycles with the logged cycles of logs, `cut` of them truncated."""
    return Found(
        len(np.setdiff1d(flown, logged)),
        len(logged) - len(np.unique(logged)),
        len(np.setdiff1d(logged, flown)),
        cut,
    )


def memory_of(supervisor: int) -> int:
    """Return a descriptor of the shared memory of the daemon's processes."""
    for link in Path(f"/proc/{supervisor}/fd").iterdir():
        with contextlib.suppress(FileNotFoundError):  # connections come and go
            if link.readlink().name.startswith("memfd:levid"):
                return os.open(link, os.O_RDWR | os.O_CLOEXEC)
    raise RuntimeError(f"expected shared memory of levid in process {supervisor}, found none")
