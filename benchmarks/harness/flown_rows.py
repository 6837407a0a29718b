"""What the loop wrote into its ring while it flew, and whether all of it stands in the logs.

The ring is looked at from outside, in the memory that the daemon's processes share, and nothing is
written there: each row that the loop meant for a log is known by its cycle, wherever it was lost.
"""

from __future__ import annotations

import contextlib
import os
import time
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from levid.config.rig import load_rig
from levid.daemon.ipc.control_words import Word
from levid.daemon.ipc.row_ring import NO_LOG
from levid.daemon.ipc.shared_memory import Shared
from levid.log.reader import read_log

Cycles = NDArray[np.int64]

_WRITTEN_S = 120.0
"""A disk that is busy may take its time; the daemon itself waits for a minute."""


class Lag(NamedTuple):
    """How many rows waited for the recorder at a time in s."""

    at_s: float
    rows: int


class Flown:
    """The rows of a flight, from the making of this on; `look` at least every few seconds."""

    def __init__(self, supervisor: int, rig_file: Path) -> None:
        self._shared = Shared(load_rig(rig_file), memory_of(supervisor))
        self._shared.close()  # the mapping stays
        self._ring, self.board = self._shared.ring, self._shared.board
        self._next = self._ring.head
        self._woken_before = self._shared.wake_ups.counts[:-1].copy()
        self._cycles: list[Cycles] = []
        self.lags: list[Lag] = []

    @property
    def capacity(self) -> int:
        """Rows that the ring holds."""
        return self._ring.capacity

    @property
    def cycles(self) -> Cycles:
        """The cycles whose rows belong into a log."""
        return np.concatenate([np.empty(0, np.int64), *self._cycles])

    @property
    def woken(self) -> Cycles:
        """Return how often the loop woke up so late, by the bins of `WakeUps`."""
        return self._shared.wake_ups.counts[:-1] - self._woken_before

    def look(self) -> None:
        """Take note of the rows that are new, and of how many wait for the recorder."""
        ring = self._ring
        self.lags.append(Lag(time.monotonic(), ring.waiting))
        head = ring.head
        places = np.arange(self._next, head) % ring.capacity
        logged = ring.tags[places] != NO_LOG
        self._cycles.append(ring.rows["cycle"][places][logged].astype(np.int64))
        if ring.head - ring.capacity >= self._next:
            raise RuntimeError("looked at the ring too late: the loop has written over rows")
        self._next = head

    def wait_until_written(self) -> None:
        """Wait until what was flown is in its files; raises RuntimeError."""
        self.look()
        ring, board = self._ring, self.board
        give_up_s = time.monotonic() + _WRITTEN_S
        while ring.durable < self._next or board[Word.WRITING] != NO_LOG:
            if time.monotonic() > give_up_s:
                raise RuntimeError(f"rows are not in their files after {_WRITTEN_S:g} s")
            time.sleep(0.02)


@dataclass(frozen=True)
class Found:
    """How the logs of a flight compare with what the loop wrote."""

    missing: int = 0
    duplicates: int = 0
    strange: int = 0  # rows of cycles that nobody flew
    cut: int = 0  # logs that are not whole

    @property
    def wrong(self) -> int:
        """Rows and logs that are not as they should be."""
        return self.missing + self.duplicates + self.strange + self.cut

    def __add__(self, other: Found) -> Found:
        return Found(
            self.missing + other.missing,
            self.duplicates + other.duplicates,
            self.strange + other.strange,
            self.cut + other.cut,
        )


def compare(flown: Cycles, logs: Iterable[Path]) -> Found:
    """Return what is wrong with the logs of a flight, in any order, of which these are cycles."""
    cycles, cut = [np.empty(0, np.int64)], 0
    for path in logs:
        log = read_log(path)
        cycles.append(log.rows["cycle"].astype(np.int64))
        cut += not log.complete
    return found_in(flown, np.concatenate(cycles), cut)


def found_in(flown: Cycles, logged: Cycles, cut: int) -> Found:
    """Return what is wrong with the rows of these cycles, that `cut` logs which end early hold."""
    return Found(
        len(np.setdiff1d(flown, logged)),
        len(logged) - len(np.unique(logged)),
        len(np.setdiff1d(logged, flown)),
        cut,
    )


def memory_of(supervisor: int) -> int:
    """Return a descriptor of the memory that the daemon's processes share."""
    for link in Path(f"/proc/{supervisor}/fd").iterdir():
        with contextlib.suppress(FileNotFoundError):  # connections come and go
            if link.readlink().name.startswith("memfd:levid"):
                return os.open(link, os.O_RDWR | os.O_CLOEXEC)
    raise RuntimeError("the daemon shows no shared memory")
