"""Stream the segments of a flight from supervisor to loop through shared memory.

The supervisor stays a few seconds ahead of the loop. The loop only reads: it maps, allocates and
waits for nothing in a cycle, however long the session is.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..control.coil_check import Pushes
from ..control.flight_segment import Segment
from ..control.states import State
from .memory_fences import acquire, release
from .shared_status_words import ControlWords, Word

Array = NDArray[np.float64]

_QUEUE = 64
_BLOCK_ROWS = 4096
_BLOCKS = 16


class Announced(NamedTuple):
    """Describe a queued segment: its plan, the log of its rows, and the index of its first row.

    `last` marks the last segment of its plan. `number` counts the segments, and `check` is the
    CRC-32 of all other fields: a slot that is not wholly written yet, or an old one, has others.
    """

    plan: int
    log: int
    state: int
    cycles: int
    first: int
    in_control: int
    airborne: int
    engages: int
    lands: int
    beam_feedforward: int
    last: int
    number: int = 0
    check: int = 0


class SegmentStream:
    """Access the queue of segments and the ring of rows: v, coil excitation, blend, beam, rotor."""

    def __init__(
        self, coils: int, rows: int, memory: memoryview, control_words: ControlWords
    ) -> None:
        self.capacity, self._words = rows, control_words.words
        self._queue: NDArray[np.int64] = np.frombuffer(
            memory, np.int64, _QUEUE * len(Announced._fields)
        ).reshape(_QUEUE, -1)
        at = self._queue.nbytes
        arrays: list[Array] = []
        for columns in (3, coils, 3, 3, 3):
            flat: Array = np.frombuffer(memory, np.float64, rows * columns, at)
            arrays.append(flat.reshape(rows, columns))
            at += flat.nbytes
        self.v, self.coil_excitation, self.blend, self.beam, self.rotor = arrays

    @staticmethod
    def size(coils: int, rows: int) -> int:
        """Return the bytes that a stream of `rows` rows needs."""
        return 8 * (_QUEUE * len(Announced._fields) + rows * (12 + coils))

    def announced(self, number: int) -> Announced | None:
        """Return segment `number` of the queue; None if its slot does not hold it."""
        acquire()
        slot = self._queue[number % _QUEUE]
        found = Announced(*slot.tolist())
        if found.number != number or found.check != zlib.crc32(slot[:-1]):
            return None
        return found

    def segment(self, announced: Announced) -> Segment:
        """Return the segment; its row k is row (first + k) % capacity of the arrays."""
        return Segment(
            State(announced.state),
            announced.cycles,
            self.v,
            self.coil_excitation,
            self.blend,
            self.beam,
            self.rotor,
            bool(announced.in_control),
            bool(announced.airborne),
            bool(announced.engages),
            bool(announced.lands),
            bool(announced.beam_feedforward),
        )

    def announce(self, announced: Announced) -> None:
        """Append a segment to the queue; requires `room_in_queue`."""
        head = self._words[Word.QUEUE_HEAD]
        slot = self._queue[head % _QUEUE]
        slot[:] = announced._replace(number=head)
        slot[-1] = zlib.crc32(slot[:-1])
        release()
        self._words[Word.QUEUE_HEAD] = head + 1

    @property
    def room_in_queue(self) -> int:
        """Segments that can be announced."""
        room = _QUEUE - (self._words[Word.QUEUE_HEAD] - self._words[Word.QUEUE_TAIL])
        acquire()
        return room

    def write(self, segment: Segment, begin: int, cycles: int) -> None:
        """Append rows [begin, begin + cycles) of a segment; requires room in the ring."""
        head = self._words[Word.ROWS_HEAD]
        while cycles:
            at = head % self.capacity
            n = min(cycles, self.capacity - at)
            for to, source in (
                (self.v, segment.v),
                (self.coil_excitation, segment.coil_excitation),
                (self.blend, segment.blend),
                (self.beam, segment.beam),
                (self.rotor, segment.rotor),
            ):
                _copy(to[at : at + n], source, begin)
            head, begin, cycles = head + n, begin + n, cycles - n
        release()
        self._words[Word.ROWS_HEAD] = head


@dataclass(frozen=True)
class Logged:
    """Pair a segment with the tag of its log."""

    segment: Segment
    log: int


class SegmentFeeder:
    """Stream one plan as far ahead as there is room; `feed` never waits."""

    def __init__(
        self,
        segment_stream: SegmentStream,
        control_words: ControlWords,
        plan: int,
        segments: Iterable[Logged],
    ) -> None:
        self._segment_stream, self._words, self.plan = segment_stream, control_words.words, plan
        self.error = ""
        """Why streaming of an invalid plan ended; the loop then lands. Empty if valid."""
        # One segment ahead of the current one, to mark the last segment as the last.
        self._segments = (logged for logged in segments if logged.segment.cycles)
        self._current, self._following = self._next(), self._next()
        self._written = 0  # rows of the current segment
        self.check: tuple[Pushes, int, int] | None = None
        """A streamed coil check: its pushes, its cycles, and its last row."""
        # Rows of an earlier plan that were not flown count as free.
        self.base = self._words[Word.ROWS_HEAD]

    def feed(self) -> None:
        """Write as many rows as there is room for; takes some milliseconds at most."""
        for _ in range(_BLOCKS):
            if self._words[Word.PLAN_DONE] >= self.plan or not self._stream():
                return

    def _stream(self) -> bool:
        """Write one block of rows; return whether there may be more."""
        segment_stream, words = self._segment_stream, self._words
        logged = self._current
        if logged is None:
            return False
        segment, first = logged.segment, words[Word.ROWS_HEAD]
        flown = max(words[Word.ROWS_TAIL], self.base)
        acquire()
        room = segment_stream.capacity - 1 - (first - flown)
        n = min(segment.cycles - self._written, room, _BLOCK_ROWS)
        if n <= 0 or not segment_stream.room_in_queue:
            return False
        if not _is_finite(segment, self._written, n):
            self.error = f"a setpoint in state {segment.state.name} is not a finite number"
        if self.error:
            return False
        segment_stream.write(segment, self._written, n)
        if segment.checks is not None and not self._written:
            self.check = segment.checks, segment.cycles, first + segment.cycles - 1
        if not self._written:  # after writing: the loop may start the segment at once
            segment_stream.announce(
                Announced(
                    self.plan,
                    logged.log,
                    segment.state,
                    segment.cycles,
                    first,
                    segment.in_control,
                    segment.airborne,
                    segment.engages,
                    segment.lands,
                    segment.beam_feedforward,
                    self._following is None,
                )
            )
        self._written += n
        if self._written == segment.cycles:
            self._current, self._following = self._following, self._next()
            self._written = 0
        return True

    def _next(self) -> Logged | None:
        """Return the next segment; None after the last one or after an error."""
        try:
            return next(self._segments, None)
        except Exception as error:  # noqa: BLE001 - an invalid plan must not end the daemon
            self.error = str(error) or type(error).__name__
            return None


def _is_finite(segment: Segment, begin: int, n: int) -> bool:
    """Return whether rows [begin, begin + n) are finite; a short array repeats its last row."""
    arrays = (
        segment.v, segment.coil_excitation, segment.blend, segment.beam, segment.rotor,
    )  # fmt: skip
    return all(np.isfinite(array[min(begin, len(array) - 1) : begin + n]).all() for array in arrays)


def _copy(to: Array, source: Array, begin: int) -> None:
    """Copy rows of `source`, starting at `begin`, to `to`; a short source repeats its last row."""
    n = min(max(len(source) - begin, 0), len(to))
    to[:n] = source[begin : begin + n]
    to[n:] = source[-1]
