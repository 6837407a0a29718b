"""The words that supervisor, loop and recorder share: requests, heartbeats, counters, a cause.

Each word is an aligned 64-bit integer in shared memory with one writer, named beside it; reading
or writing one neither waits nor fails. This is the one way into a stop: it needs no log, no socket
and no answer, and asking twice is asking once.
"""

from __future__ import annotations

from enum import IntEnum, auto

from ..control.faults import Fault
from ..control.states import State


class Word(IntEnum):
    """Places on the board."""

    # From the supervisor.
    BEAT = 0  # counts on while the supervisor is alive
    LAND = auto()  # counts requests to land
    ZERO = auto()  # the fault to stop with at once, 0 for none; any process may set it
    CLEAR = auto()  # counts requests to clear a fault
    CLEAR_STOPS = auto()  # STOPS when the last of them came: later ones are not taken back by it
    STOPS = auto()  # counts requests to stop
    END = auto()  # 1: land and end
    QUEUE_HEAD = auto()  # segments announced
    ROWS_HEAD = auto()  # rows of the program that are there
    LAND_RAMP = auto()  # cycles of sinking, should the plan at hand be landed before its end
    LAND_RELEASE = auto()  # cycles of letting go
    LAND_LOG = auto()  # tag of the log that takes such a landing
    HEAT_MONOTONIC_NS = auto()  # when the coils' heat was taken over, before cycle 0
    # From the loop.
    CYCLE = auto()
    STATE = auto()
    FAULT = auto()
    LATE = auto()  # late cycles since the start
    STALE = auto()  # cycles with stale readings
    QUEUE_TAIL = auto()  # segments begun or dropped
    ROWS_TAIL = auto()  # rows of the program that were flown
    PLAN = auto()  # the plan that is flown, 0 for none
    PLAN_DONE = auto()  # the last plan that ended
    PLAN_CUT = auto()  # the last plan that was ended before its end
    FAULT_CYCLE = auto()  # when the fault came
    FAULT_PLAN = auto()  # in which plan
    FAULT_LOG = auto()  # in which log
    LOG = auto()  # tag of the rows at hand
    CLEARED = auto()  # the last request to clear that was answered
    BUSY = auto()  # 1: not in the cycle, devices are being opened or recovered
    WAITING = auto()  # counts while the loop waits to be told to try again
    LOOPS = auto()  # how often the loop was started
    EPOCH_NS = auto()  # log time of cycle 0
    EPOCH_MONOTONIC_NS = auto()
    # From the recorder.
    RECORDER_BEAT = auto()
    DROPPED = auto()  # rows that should be in a log and are not
    WRITING = auto()  # tag of the log that is being written
    FAULTS_SEEN = auto()  # rows that were looked through for faults, what was found being on disk


_TEXT_BYTES = 512
_WORDS_BYTES = 8 * len(Word)


class Board:
    """The words in `memory`, and a text that says in words what FAULT is about."""

    SIZE = _WORDS_BYTES + _TEXT_BYTES

    def __init__(self, memory: memoryview) -> None:
        self.words = memory[:_WORDS_BYTES].cast("q")
        self._text = memory[_WORDS_BYTES : self.SIZE]

    def __getitem__(self, word: Word) -> int:
        return self.words[word]

    def __setitem__(self, word: Word, value: int) -> None:
        self.words[word] = value

    @property
    def state(self) -> State:
        """What the loop is doing, by its own word."""
        return State(self.words[Word.STATE])

    @property
    def fault(self) -> Fault:
        """The fault that the loop is in."""
        return Fault(self.words[Word.FAULT])

    @property
    def detail(self) -> str:
        """What the fault is about, in words; written before FAULT is."""
        return bytes(self._text).partition(b"\0")[0].decode(errors="replace")

    @detail.setter
    def detail(self, text: str) -> None:
        data = text.encode()[: _TEXT_BYTES - 1]
        self._text[:] = data.ljust(_TEXT_BYTES, b"\0")

    def stop(self, fault: Fault = Fault.STOPPED, detail: str = "") -> None:
        """Ask for zero force at once, with this fault as the cause unless there is one already."""
        if not self.words[Word.ZERO]:
            if detail:
                self.detail = detail
            self.words[Word.ZERO] = fault
        self.words[Word.STOPS] += 1

    def clear(self, stops: int | None = None) -> None:
        """Ask for the fault to be cleared, and for what stopped the loop to be taken back.

        `stops`: STOPS when somebody asked for this, now unless given.
        """
        words = self.words
        words[Word.CLEAR_STOPS] = words[Word.STOPS] if stops is None else stops
        words[Word.CLEAR] += 1

    def take_back_stop(self) -> None:
        """Forget a stop, unless one came after the clear that is being answered was asked for."""
        if self.words[Word.STOPS] == self.words[Word.CLEAR_STOPS]:
            self.words[Word.ZERO] = 0

    def land(self) -> None:
        """Ask for a landing, in whatever flight there is."""
        self.words[Word.LAND] += 1
