"""The ring of log rows between the timed loop, which never waits, and the recorder, which may."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


class Ring:
    """`head` rows were written by the loop, `tail` of them taken by the recorder.

    One writer and one reader, each changing only its own counter. Row `capacity` is spare: when the
    ring is full the loop writes there and counts the row as lost.
    """

    def __init__(self, dtype: np.dtype[np.void], capacity: int) -> None:
        self.rows: NDArray[np.void] = np.zeros(capacity + 1, dtype)
        self.capacity = capacity
        self.head = 0
        self.tail = 0
        self.lost = 0

    def take(self, up_to: int, most: int) -> NDArray[np.void]:
        """Return a copy of the oldest rows before `up_to`, at most `most`, and free their room."""
        n = min(up_to - self.tail, most)
        first = self.tail % self.capacity
        if first + n <= self.capacity:
            taken = self.rows[first : first + n].copy()
        else:
            rest = first + n - self.capacity
            taken = np.concatenate([self.rows[first : self.capacity], self.rows[:rest]])
        self.tail += n
        return taken

    @property
    def waiting(self) -> int:
        """Rows that the recorder has not taken yet."""
        return self.head - self.tail

    @property
    def room(self) -> int:
        """Rows that can be written before the ring is full."""
        return self.capacity - self.waiting
