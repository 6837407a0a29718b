"""Control words shared by supervisor, loop and recorder: requests, heartbeats, counters, faults.

Each word is an aligned 64-bit integer in shared memory with one writer. Reading or writing it never
waits or fails. All stops go through these words: they need no log, socket or answer, and a repeated
request has no further effect.
"""

from __future__ import annotations

from enum import IntEnum, auto

from ..control.faults import Fault
from ..control.states import State
from .memory_fences import acquire, release


class Word(IntEnum):
    """Index the control words."""

    # From the supervisor.
    BEAT = 0  # heartbeat counter of the supervisor
    LAND = auto()  # counts requests to land
    ZERO = auto()  # fault that requests zero force at once, 0 for none; any process may set it
    CLEAR = auto()  # counts requests to clear a fault
    CLEAR_STOPS = auto()  # STOPS at the last request to clear: it does not cancel later stops
    STOPS = auto()  # counts requests to stop
    END = auto()  # 1: land, then end the process
    QUEUE_HEAD = auto()  # segments announced
    ROWS_HEAD = auto()  # program rows written
    LAND_RAMP = auto()  # cycles for lowering the platform, if the plan is ended early by a landing
    LAND_RELEASE = auto()  # cycles for fading out the force in such a landing
    LAND_LOG = auto()  # tag of the log of such a landing
    HEAT_MONOTONIC_NS = auto()  # time at which the coil heat was loaded, before cycle 0
    # From the loop.
    CYCLE = auto()
    STATE = auto()
    FAULT = auto()
    LATE = auto()  # late cycles since the start
    STALE = auto()  # cycles with stale readings
    QUEUE_TAIL = auto()  # segments started or dropped
    ROWS_TAIL = auto()  # program rows flown
    PLAN = auto()  # number of the current plan, 0 for none
    PLAN_DONE = auto()  # number of the last plan that ended
    PLAN_CUT = auto()  # number of the last plan that ended early
    FAULT_CYCLE = auto()  # cycle of the fault
    FAULT_PLAN = auto()  # plan of the fault
    FAULT_LOG = auto()  # log of the fault
    LOG = auto()  # tag of the current rows
    CLEARED = auto()  # number of the last request to clear that was answered
    BUSY = auto()  # 1: no cycles, devices are being opened or recovered
    WAITING = auto()  # counts while the loop waits for a request to clear
    LOOPS = auto()  # counts starts of the loop
    EPOCH_NS = auto()  # log time of cycle 0
    EPOCH_MONOTONIC_NS = auto()  # monotonic time of cycle 0
    # From the recorder.
    RECORDER_BEAT = auto()  # heartbeat counter of the recorder
    DROPPED = auto()  # rows missing in their log
    WRITING = auto()  # tag of the log being written
    FAULTS_SEEN = auto()  # rows searched for faults, with their flight recordings on disk


_TEXT_BYTES = 512
_WORDS_BYTES = 8 * len(Word)


class ControlWords:
    """Access the control words in `memory`, and the detail text of FAULT."""

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
        """State of the loop."""
        return State(self.words[Word.STATE])

    @property
    def fault(self) -> Fault:
        """Current fault of the loop."""
        fault = Fault(self.words[Word.FAULT])
        acquire()
        return fault

    @property
    def detail(self) -> str:
        """Detail text of the fault; written before FAULT."""
        return bytes(self._text).partition(b"\0")[0].decode(errors="replace")

    @detail.setter
    def detail(self, text: str) -> None:
        data = text.encode()[: _TEXT_BYTES - 1]
        self._text[:] = data.ljust(_TEXT_BYTES, b"\0")
        release()  # the fault that it explains is written next

    def stop(self, fault: Fault = Fault.STOPPED, detail: str = "") -> None:
        """Request zero force at once with this fault, unless another one is set already."""
        if not self.words[Word.ZERO]:
            if detail:
                self.detail = detail
            self.words[Word.ZERO] = fault
        self.words[Word.STOPS] += 1

    def clear(self, stops: int | None = None) -> None:
        """Request that the fault is cleared and the stop cancelled.

        `stops`: value of STOPS when the client sent the request; default: the present value.
        """
        words = self.words
        words[Word.CLEAR_STOPS] = words[Word.STOPS] if stops is None else stops
        words[Word.CLEAR] += 1

    def cancel_stop(self) -> None:
        """Cancel a stop, unless another one came after the request to clear."""
        if self.words[Word.STOPS] == self.words[Word.CLEAR_STOPS]:
            self.words[Word.ZERO] = 0

    def land(self) -> None:
        """Request a landing of the current flight, if any."""
        self.words[Word.LAND] += 1
