"""The ring of log rows between the timed loop, which never waits, and the recorder, which may."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...config.service import Recording

NO_LOG = 0
"""Tag of a row that belongs into no log."""

_HEAD, _TAIL, _DURABLE, _LOST, _COUNTERS = range(5)
_ALIGNMENT = 64
HUNG_S = 10.0
"""After so long without a sign of life a recorder is killed, and another one started."""
_STARTING_S = 5.0
_BEHIND_S = HUNG_S + _STARTING_S
"""How far the recorder may fall behind, beside what a flight recording looks back on: a fault that
comes as it begins to hang is written by the next one, whole. 41 MB at 10 kHz."""
_LEAST_ROWS = 4096


@dataclass(frozen=True)
class RingRows:
    """Consecutive rows (n,) from number `first` on, and the tag (n,) of the log each goes into."""

    first: int
    rows: NDArray[np.void]
    tags: NDArray[np.uint32]


class Ring:
    """One writer that never looks at its reader; one reader that notices what it was too slow for.

    Rows have numbers from 0 on, row n lies in slot n % capacity. The writer fills the slot, then
    publishes `head` = n + 1; it writes over the oldest row whoever has read it, so that the newest
    `capacity` rows are always there. The reader publishes `tail`, the rows it took, and `durable`,
    those that are on disk: where a reader that died is to be followed by another. `lost` counts
    rows that were written over unread.

    `memory` is shared with other processes, zero at first; without it the ring is this process's
    own. Counters are aligned words, and a cycle ends in a system call: what was published is seen.
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
        return self.words[_HEAD]

    @head.setter
    def head(self, value: int) -> None:
        self.words[_HEAD] = value

    @property
    def tail(self) -> int:
        """Rows that the reader has taken, or lost."""
        return self.words[_TAIL]

    @tail.setter
    def tail(self, value: int) -> None:
        self.words[_TAIL] = value

    @property
    def durable(self) -> int:
        """Rows that need not be read again."""
        return self.words[_DURABLE]

    @durable.setter
    def durable(self, value: int) -> None:
        self.words[_DURABLE] = value

    @property
    def lost(self) -> int:
        """Rows that were written over before they were read."""
        return self.words[_LOST]

    @lost.setter
    def lost(self, value: int) -> None:
        self.words[_LOST] = value

    @property
    def waiting(self) -> int:
        """Rows that the reader has not taken yet."""
        return self.head - self.tail

    @property
    def room(self) -> int:
        """Rows that can be written before one is lost; the slot of the oldest is never sure."""
        return self.capacity - 1 - self.waiting

    def take(self, most: int) -> RingRows:
        """Return the oldest rows that were not taken, at most `most`, and count those lost."""
        found = self.copy(self.tail, most)
        self.lost += found.first - self.tail
        self.tail = found.first + len(found.rows)
        return found

    def last(self, n: int) -> RingRows:
        """Return the newest rows, at most `n`, taken or not."""
        head = self.head
        n = min(n, head, self.capacity - 1)
        return self.copy(head - n, n)

    def copy(self, first: int, most: int) -> RingRows:
        """Return at most `most` rows from number `first` on; later ones where those are gone."""
        head = self.head
        first = max(first, head - self.capacity + 1)
        end = min(first + most, head)
        places = np.arange(first, end) % self.capacity
        if end > first and places[0] <= places[-1]:
            run = slice(int(places[0]), int(places[-1]) + 1)
            rows, tags = self.rows[run].copy(), self.tags[run].copy()
        else:
            rows, tags = self.rows[places], self.tags[places]
        # What the writer may have begun to write over in the meantime does not count.
        spoilt = min(max(self.head - self.capacity + 1 - first, 0), len(rows))
        return RingRows(first + spoilt, rows[spoilt:], tags[spoilt:])


def ring_rows(recording: Recording, rate_hz: float) -> int:
    """Return the capacity of the ring of a loop at this rate."""
    return max(int((recording.before_fault_s + _BEHIND_S) * rate_hz), _LEAST_ROWS)


def _aligned(size: int) -> int:
    return -(-size // _ALIGNMENT) * _ALIGNMENT
