"""The program of a flight in shared memory: segments announced ahead, their rows streamed behind.

The supervisor keeps a few seconds of it ahead of the loop, which only ever looks: nothing is
mapped, allocated or waited for in a cycle, however long a session is.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..control.coil_check import Pushes
from ..control.segment import Segment
from ..control.states import State
from .control_words import Board, Word

Array = NDArray[np.float64]

_QUEUE = 64
_PIECE = 4096
_PIECES = 16


class Announced(NamedTuple):
    """A segment in the queue: its plan, the log of its rows, and where its first row lies.

    `last` ends its plan.
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
    last: int


class Program:
    """A queue of segments and a ring of rows: excitation v, coils, blend, beam, rotor."""

    def __init__(self, coils: int, rows: int, memory: memoryview, board: Board) -> None:
        self.capacity, self._words = rows, board.words
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
        """Return the bytes that a program of so many rows needs."""
        return 8 * (_QUEUE * len(Announced._fields) + rows * (12 + coils))

    def announced(self, number: int) -> Announced:
        """Return segment `number` of the queue."""
        return Announced(*self._queue[number % _QUEUE].tolist())

    def segment(self, announced: Announced) -> Segment:
        """Return the segment to fly: row k of it is row (first + k) % capacity of the arrays."""
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
        )

    def announce(self, announced: Announced) -> None:
        """Put a segment into the queue; there must be room."""
        head = self._words[Word.QUEUE_HEAD]
        self._queue[head % _QUEUE] = announced
        self._words[Word.QUEUE_HEAD] = head + 1

    @property
    def room_in_queue(self) -> int:
        """Segments that can be announced."""
        return _QUEUE - (self._words[Word.QUEUE_HEAD] - self._words[Word.QUEUE_TAIL])

    def write(self, segment: Segment, begin: int, cycles: int) -> None:
        """Append rows [begin, begin + cycles) of a segment; there must be room."""
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
        self._words[Word.ROWS_HEAD] = head


@dataclass(frozen=True)
class Logged:
    """A segment, and the tag of the log that it goes into."""

    segment: Segment
    log: int


class Feeder:
    """Streams and announces one plan, as far ahead as there is room; `feed` never waits."""

    def __init__(
        self, program: Program, board: Board, plan: int, segments: Iterable[Logged]
    ) -> None:
        self._program, self._words, self.plan = program, board.words, plan
        self.wrong = ""
        """Why nothing more is streamed of a plan that cannot be flown; the loop then lands."""
        # One ahead of what is being streamed: the last segment is announced as the last.
        self._coming = (logged for logged in segments if logged.segment.cycles)
        self._at, self._following = self._next(), self._next()
        self._written = 0  # rows of the segment at hand
        self.check: tuple[Pushes, int, int] | None = None
        """A check of coils that is streamed: its pushes, its cycles, and its last row."""
        # What an earlier plan left unflown is of no use to anyone.
        self.base = self._words[Word.ROWS_HEAD]

    def feed(self) -> None:
        """Do what there is room for, some milliseconds of work at most."""
        for _ in range(_PIECES):
            if self._words[Word.PLAN_DONE] >= self.plan or not self._stream():
                return

    def _stream(self) -> bool:
        """Write one piece; return whether there may be more to do."""
        program, words = self._program, self._words
        logged = self._at
        if logged is None:
            return False
        segment, first = logged.segment, words[Word.ROWS_HEAD]
        flown = max(words[Word.ROWS_TAIL], self.base)
        n = min(segment.cycles - self._written, program.capacity - 1 - (first - flown), _PIECE)
        if n <= 0 or not program.room_in_queue:
            return False
        if not _is_finite(segment, self._written, n):
            self.wrong = f"it has a setpoint that is no number, in {segment.state.name}"
        if self.wrong:
            return False
        program.write(segment, self._written, n)
        if segment.checks is not None and not self._written:
            self.check = segment.checks, segment.cycles, first + segment.cycles - 1
        if not self._written:  # only now: the loop may begin it at once
            program.announce(
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
                    self._following is None,
                )
            )
        self._written += n
        if self._written == segment.cycles:
            self._at, self._following = self._following, self._next()
            self._written = 0
        return True

    def _next(self) -> Logged | None:
        """Return the next segment, None after the last, or where it cannot be had."""
        try:
            return next(self._coming, None)
        except Exception as error:  # noqa: BLE001 - the plan is wrong, and not the daemon
            self.wrong = str(error) or type(error).__name__
            return None


def _is_finite(segment: Segment, begin: int, n: int) -> bool:
    """Return whether rows [begin, begin + n) are numbers; a row beyond an array's is its last."""
    arrays = (
        segment.v, segment.coil_excitation, segment.blend, segment.beam, segment.rotor,
    )  # fmt: skip
    return all(np.isfinite(array[min(begin, len(array) - 1) : begin + n]).all() for array in arrays)


def _copy(to: Array, source: Array, begin: int) -> None:
    """Fill `to` with rows of `source` from `begin` on, the last of them again where it ends."""
    n = min(max(len(source) - begin, 0), len(to))
    to[:n] = source[begin : begin + n]
    to[n:] = source[-1]
