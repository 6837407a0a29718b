"""Ring buffer of log rows from the loop, which never waits, to the recorder."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...config.daemon_settings import Recording
from .memory_fences import acquire, release

NO_LOG = 0
"""Tag of a row that belongs to no log."""

_HEAD, _TAIL, _DURABLE, _LOST, _COUNTERS = range(5)
_ALIGNMENT = 64
HUNG_S = 10.0
"""Time without a heartbeat after which the recorder is killed and restarted."""
_STARTING_S = 5.0
_BEHIND_S = HUNG_S + _STARTING_S
"""Delay of the recorder that the ring covers in addition to a flight recording. If a fault occurs
while the recorder hangs, the next recorder still writes a complete flight recording. 41 MB at
10 kHz."""
_MIN_ROWS = 4096


@dataclass(frozen=True)
class RingRows:
    """Hold consecutive rows (n,), starting at row number `first`, and their log tags (n,)."""

    first: int
    rows: NDArray[np.void]
    tags: NDArray[np.uint32]


class Ring:
    """Pass rows from one writer that never waits to one reader that detects overwritten rows.

    Rows are numbered from 0; row n is in slot n % capacity. The writer fills the slot, then sets
    `head` = n + 1. It overwrites the oldest row, read or not: the newest `capacity` rows are always
    available. The reader sets `tail`, the rows it has read, and `durable`, the rows on disk, from
    which a restarted reader continues. `lost` counts rows overwritten unread.

    `memory` is shared with other processes and initially zero; without it the ring is private.
    Counters are aligned words, with a fence between them and the rows they count.
    """

    def __init__(
        self, dtype: np.dtype[np.void], capacity: int, memory: memoryview | None = None
    ) -> None:
        if memory is None:
            memory = memoryview(bytearray(self.size(dtype, capacity)))
        self.dtype, self.capacity = dtype, capacity
        self.words = memory[: 8 * _COUNTERS].cast("q")
        at = _ALIGNMENT
        self.tags: NDArray[np.uint32] = np.frombuffer(memory, np.uint32, capacity, at)
        at += _aligned(4 * capacity)
        self.rows: NDArray[np.void] = np.frombuffer(memory, dtype, capacity, at)

    @staticmethod
    def size(dtype: np.dtype[np.void], capacity: int) -> int:
        """Return the bytes that a ring of this capacity needs."""
        return _ALIGNMENT + _aligned(4 * capacity) + dtype.itemsize * capacity

    @property
    def head(self) -> int:
        """Rows written so far."""
        value = self.words[_HEAD]
        acquire()
        return value

    @head.setter
    def head(self, value: int) -> None:
        release()
        self.words[_HEAD] = value
        release()  # the next row, which overwrites an old one, must not be seen before this

    @property
    def tail(self) -> int:
        """Rows that the reader has read or lost."""
        return self.words[_TAIL]

    @tail.setter
    def tail(self, value: int) -> None:
        self.words[_TAIL] = value

    @property
    def durable(self) -> int:
        """Rows that a restarted reader need not read again."""
        return self.words[_DURABLE]

    @durable.setter
    def durable(self, value: int) -> None:
        self.words[_DURABLE] = value

    @property
    def lost(self) -> int:
        """Rows overwritten before they were read."""
        return self.words[_LOST]

    @lost.setter
    def lost(self, value: int) -> None:
        self.words[_LOST] = value

    @property
    def waiting(self) -> int:
        """Rows that the reader has not read yet."""
        return self.head - self.tail

    @property
    def room(self) -> int:
        """Rows that can be written before one is lost; the oldest slot does not count."""
        return self.capacity - 1 - self.waiting

    def take(self, limit: int) -> RingRows:
        """Read the oldest unread rows, at most `limit`; advance `tail` and count lost rows."""
        unread = self.copy(self.tail, limit)
        self.lost += unread.first - self.tail
        self.tail = unread.first + len(unread.rows)
        return unread

    def last(self, n: int) -> RingRows:
        """Return the newest rows, at most `n`, read or not."""
        head = self.head
        n = min(n, head, self.capacity - 1)
        return self.copy(head - n, n)

    def copy(self, first: int, limit: int) -> RingRows:
        """Return at most `limit` rows from row `first`, or from the oldest available row."""
        head = self.head
        first = max(first, head - self.capacity + 1)
        end = min(first + limit, head)
        places = np.arange(first, end) % self.capacity
        if end > first and places[0] <= places[-1]:
            run = slice(int(places[0]), int(places[-1]) + 1)
            rows, tags = self.rows[run].copy(), self.tags[run].copy()
        else:
            rows, tags = self.rows[places], self.tags[places]
        # Discard rows that the writer may have overwritten during the copy, which is complete.
        acquire()
        overwritten = min(max(self.head - self.capacity + 1 - first, 0), len(rows))
        return RingRows(first + overwritten, rows[overwritten:], tags[overwritten:])


def ring_rows(recording: Recording, rate_hz: float) -> int:
    """Return the capacity of the ring in rows for a loop at `rate_hz`."""
    return max(int((recording.before_fault_s + _BEHIND_S) * rate_hz), _MIN_ROWS)


def _aligned(size: int) -> int:
    return -(-size // _ALIGNMENT) * _ALIGNMENT
