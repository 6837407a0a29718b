"""What the next cycle flies, and why: a program, a landing, a self-test, or zero force.

What it looks at are words in shared memory. It takes no lock, writes no file and asks nobody.
"""

from __future__ import annotations

import gc
import os
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ...config.rig import RigConfig
from ..control.control_cycle import Controller
from ..control.faults import Fault
from ..control.landing import Landing, Motion
from ..control.lateness import Lateness
from ..control.segment import Segment
from ..control.self_test import self_test
from ..control.states import State
from ..ipc.control_words import Word
from ..ipc.row_ring import NO_LOG
from ..ipc.segment_stream import Announced
from ..ipc.shared_memory import Shared
from .warm_up import resting_segment

AROUND_CLEAR = 2
"""Cycles that do not count as late or long: one in which a clear was seen to, and the next."""
_AFTER_FAULT_S = 0.5
_TESTS = 10
"""How often the self-test is tried before it has failed."""
_MOST_AT_ONCE = 8
"""Periods that one look at the supervisor's sign of life counts."""
_FLYING = np.ones((1, 3))
_FOREVER = 1 << 62
# Indexing by an IntEnum costs a call; by a plain integer it does not.
(
    _BEAT, _LAND, _ZERO, _CLEAR, _END, _CYCLE, _ROWS_HEAD, _ROWS_TAIL, _QUEUE_HEAD, _QUEUE_TAIL,
    _LATE,
) = (
    int(word)
    for word in (
        Word.BEAT, Word.LAND, Word.ZERO, Word.CLEAR, Word.END, Word.CYCLE, Word.ROWS_HEAD,
        Word.ROWS_TAIL, Word.QUEUE_HEAD, Word.QUEUE_TAIL, Word.LATE,
    )
)  # fmt: skip


class Course:
    """Chooses what TimedLoop flies, cycle by cycle: `look` at the board, then `advance`.

    Without a segment to fly it stands: at zero force if control is off, else holding the platform
    where it is. `make_good` makes devices good after a fault; it may take long. `advance` returns
    which row of control's arrays is next; it is another method as what is flown is another thing.
    """

    def __init__(
        self,
        rig: RigConfig,
        controller: Controller,
        shared: Shared,
        lateness: Lateness,
        make_good: Callable[[], None],
        parent: int,
    ) -> None:
        self._rig, self._controller, self._lateness = rig, controller, lateness
        self._board, self._ring, self._program = shared.board, shared.ring, shared.program
        self._words, self._make_good, self._parent = shared.board.words, make_good, parent
        self._landing = Landing(controller, rig.limits, 1.0 / rig.rate_hz)
        self._test_cycles = max(round(rig.self_test.duration_s * rig.rate_hz), 2)
        self._most_silent = max(round(rig.service.supervisor_s * rig.rate_hz), 2)

        words = self._words
        self.state = State.OFF
        self.fault = Fault.NONE
        self.ended = False
        self.tag = NO_LOG
        """The log that the row at hand belongs to."""
        self.located = True
        """Whether it is known where the manipulator is, so that it may be told where to be."""
        self.uncounted = 0
        """Cycles around a clear that are left."""
        self.advance: Callable[[], int] = self._stand
        self._beat, self._silent = words[_BEAT], 0
        self._land_seen, self._clear_seen = words[_LAND], words[_CLEAR]
        self._after_landing: tuple[Fault, str] | None = None
        self._ending = self._orphan = False
        self._tagged_left = _FOREVER
        self._k = self._left = self._tries = self._position = 0
        self._announced: Announced | None = None

    def begin(self) -> None:
        """Begin with a self-test, at zero force."""
        self._words[Word.CLEARED] = self._clear_seen
        self._begin_self_test()

    def count_down(self) -> int:
        """Return how many of the cycles around a clear there are, this one included."""
        self.uncounted -= 1
        return self.uncounted + 1

    def look(self, periods: int) -> None:
        """Notice what others want, and whether the supervisor is there to want anything."""
        words = self._words
        self._look_after_supervisor(periods)
        if words[_ZERO] and not self.fault:
            self.fail(Fault(words[_ZERO]), None)  # who asks has said why
        if words[_LAND] != self._land_seen:
            self._land_seen = words[_LAND]
            self._land()
        if words[_CLEAR] != self._clear_seen:
            self._clear(words[_CLEAR])
        if words[_END] and not self._ending:
            self._ending = True
            self._land()
        if self._tagged_left < _FOREVER:
            self._tagged_left -= periods
            if self._tagged_left <= 0:
                self._end_plan()
        if (self._ending or self._orphan) and not self._controller.engaged:
            # After a fault the rows of the next half second are part of its story.
            self.ended = self._tagged_left == _FOREVER
            if self.ended and words[Word.PLAN]:
                self._end_plan()

    def fail(self, fault: Fault, detail: str | None = "") -> None:
        """Zero force from here on; what came first is the cause."""
        control, words = self._controller, self._words
        control.halt()
        if self.fault:
            return
        self.fault, self._after_landing = fault, None
        control.latch(fault)
        if detail is not None:
            self._board.detail = detail
        words[Word.FAULT_CYCLE] = words[_CYCLE]
        words[Word.FAULT_PLAN] = words[Word.PLAN]
        words[Word.FAULT_LOG] = self.tag
        words[Word.FAULT] = fault
        words[Word.PLAN_CUT] = max(words[Word.PLAN], words[Word.PLAN_CUT])
        self._tagged_left = max(round(_AFTER_FAULT_S * self._rig.rate_hz), 1)
        self._rest(State.FAULT, self._landing.brake())
        self._k, self.advance = 0, self._brake

    def become(self, state: State) -> None:
        """Be in `state`, and let the board tell it."""
        self.state = state
        self._words[Word.STATE] = state

    def _look_after_supervisor(self, periods: int) -> None:
        words = self._words
        beat = words[_BEAT]
        if beat != self._beat:
            self._beat, self._silent = beat, 0
        else:
            # A machine that stood still did so for the supervisor too: that is no silence.
            self._silent += min(periods, _MOST_AT_ONCE)
            if self._silent > self._most_silent:
                self._abandoned("it gave no sign of life")
        if os.getppid() != self._parent and not self._orphan:
            self._orphan = True
            self._abandoned("it is dead")

    # What row of which arrays the next cycle flies; one of these is `advance`.

    def _stand(self) -> int:
        """Hold, or rest at zero force; begin the next segment if one is announced."""
        words = self._words
        if words[_QUEUE_TAIL] < words[_QUEUE_HEAD]:
            self._next_segment()
            if self.advance != self._stand:
                return self.advance()
        return 0

    def _fly_program(self) -> int:
        """Fly the next row of the segment at hand, or the first of the one that follows."""
        words = self._words
        if not self._left:
            announced = self._announced
            assert announced is not None
            if announced.last:
                self._end_plan()
            elif words[_QUEUE_TAIL] >= words[_QUEUE_HEAD]:
                self._starved("it left the loop without a segment to fly")
            else:
                self._next_segment()
            if not self._left:
                return self.advance()
        position = self._position
        if position >= words[_ROWS_HEAD]:
            self._starved("it left the loop without rows to fly")
            return self.advance()
        self._left -= 1
        self._position = position + 1
        words[_ROWS_TAIL] = position
        return position % self._program.capacity

    def _fly_landing(self) -> int:
        """Fly the next row of a landing that nobody planned."""
        if not self._landing.set_row(self._k):
            self._end_plan()
            return 0
        self._k += 1
        return 0

    def _brake(self) -> int:
        """Bring the manipulator to rest at zero force, then stand."""
        if not self._landing.set_motion(self._k):
            self.advance = self._stand
        self._k += 1
        return 0

    def _self_test(self) -> int:
        """Rest for so many cycles, then judge the readings that they gave."""
        self._left -= 1
        if self._left > 0:
            return 0
        rows = self._ring.last(self._test_cycles - 1).rows
        wrong = self_test(rows[rows["state"] == State.SELF_TEST], self._rig)
        self._tries -= 1
        if not wrong:
            self._rest(State.IDLE)
        elif self._tries:
            self._left = self._test_cycles  # a platform that has just dropped comes to rest
        else:
            self.fail(Fault.SELF_TEST, wrong)
        return 0

    # What changes between cycles.

    def _next_segment(self) -> None:
        words = self._words
        number = words[_QUEUE_TAIL]
        announced = self._program.announced(number)
        words[_QUEUE_TAIL] = number + 1
        self._left = 0
        going_on = announced.plan == words[Word.PLAN]
        # Who is about to end begins nothing, and goes on with the landing of the plan at hand.
        unwanted = self.fault or (self._ending and not going_on)
        if unwanted or announced.plan <= words[Word.PLAN_CUT]:
            words[Word.PLAN_CUT] = max(announced.plan, words[Word.PLAN_CUT])
            if not going_on:  # else its last rows are still to come
                words[Word.PLAN_DONE] = max(announced.plan, words[Word.PLAN_DONE])
            self.advance = self._stand
            return
        if self._begin(self._program.segment(announced)):
            words[Word.PLAN] = announced.plan
            self._announced = announced
            self._label(announced.log)
            self._left, self._position = announced.cycles, announced.first
            self.advance = self._fly_program

    def _begin(self, segment: Segment) -> bool:
        """Hand a segment to control; refuse one that may not follow."""
        if not self.state.may_become(segment.state):
            self.fail(Fault.SEQUENCE, f"{segment.state.name} after {self.state.name}")
            return False
        if segment.engages:
            self._lateness.reset()  # what was late at zero force harmed nobody
        self._controller.begin(segment)
        self.become(segment.state)
        return True

    def _rest(self, state: State, motion: Motion | None = None) -> None:
        """Stand at zero force in `state`, the manipulator at rest, or in `motion` of its own."""
        resting = resting_segment(self._controller, _FOREVER)
        if motion is not None:
            resting = replace(resting, beam=motion[0], rotor=motion[1])
        self._begin(replace(resting, state=state))
        self.advance = self._stand

    def _hold(self) -> None:
        """Hold the platform, and the manipulator at rest, until told otherwise."""
        resting = resting_segment(self._controller, _FOREVER)
        self._begin(
            replace(resting, state=State.LEVITATING, blend=_FLYING, in_control=True, airborne=True)
        )
        self.advance = self._stand

    def _land(self) -> None:
        """Land from here; without control there is nothing to land, only a plan to drop."""
        words = self._words
        if self.state is State.LANDING:
            if not words[Word.PLAN]:  # a move that came as this began is not for the ground
                words[Word.PLAN_CUT] = max(words[Word.PLAN_CUT], self._last_announced)
            return
        words[Word.PLAN_CUT] = max(words[Word.PLAN], words[Word.PLAN_CUT], self._last_announced)
        if self.fault:
            return  # its rows are its story
        if not self._controller.engaged:
            if words[Word.PLAN]:
                self._end_plan()
            return
        self._land_unplanned()

    @property
    def _last_announced(self) -> int:
        """The plan of the last segment that is announced and has not begun; 0 for none."""
        words = self._words
        head = words[_QUEUE_HEAD]
        return self._program.announced(head - 1).plan if words[_QUEUE_TAIL] < head else 0

    def _land_unplanned(self, after: NDArray[np.float64] | None = None) -> None:
        """Fly a landing from here, or from where one that was planned has left off, (3,)."""
        words = self._words
        self._landing.begin(words[Word.LAND_RAMP], words[Word.LAND_RELEASE])
        # What has begun to sink does so from where it began.
        if self._begin(replace(self._landing.segment, lands=after is None)):
            self._label(words[Word.LAND_LOG])
            self._k = 0 if after is None else self._landing.row_after(after)
            self.advance = self._fly_landing

    def _end_plan(self) -> None:
        """The plan at hand is over: its rows end here, or half a second after a fault."""
        words = self._words
        after = self._after_landing
        landed = self.state is State.LANDING or not self._controller.engaged
        if after is not None and not self.fault and landed:
            self._after_landing = None
            self.fail(*after)  # of this plan, as whoever asked for it is told
            return
        words[_LATE] = self._lateness.late  # whoever sees the plan's end counts up to it
        words[Word.PLAN_DONE] = max(words[Word.PLAN], words[Word.PLAN_DONE])
        words[Word.PLAN] = 0
        self._tagged_left = _FOREVER
        if self.fault:
            self._label(NO_LOG)
        elif self.state is not State.LANDING and self._controller.engaged:
            self._hold()  # it goes on flying, and the log with it
        else:
            self._label(NO_LOG)
            self._rest(State.IDLE)

    def _starved(self, why: str) -> None:
        """The plan goes on and its rows are not there."""
        self._left = 0
        self._abandoned(why)
        if self.advance != self._fly_program:
            return
        # At zero force it is enough to drop the plan; who was about to land anyway goes on landing.
        words = self._words
        words[Word.PLAN_CUT] = max(words[Word.PLAN], words[Word.PLAN_CUT])
        announced = self._announced
        if self._controller.engaged and self.state is State.LANDING and announced is not None:
            blend = self._program.segment(announced).blend
            self._land_unplanned(after=blend[(self._position - 1) % len(blend)])
        else:
            self._end_plan()

    def _abandoned(self, why: str) -> None:
        """The supervisor is gone: land or let go, as configured."""
        if self.fault or self._after_landing is not None:
            return
        if self._rig.service.supervisor_gone == "land" and self._controller.engaged:
            self._after_landing = Fault.SUPERVISOR, why
            self._land()
        elif self._controller.engaged or self._orphan:
            self.fail(Fault.SUPERVISOR, why)

    def _clear(self, request: int) -> None:
        """Make the devices good, then test; may take long, at zero force."""
        self._clear_seen = request
        words = self._words
        if self.fault:
            self._board.take_back_stop()  # nobody but who has stopped does that
            if self._tagged_left < _FOREVER:
                self._end_plan()  # its story ends here
            words[Word.BUSY] = 1
            self.uncounted = AROUND_CLEAR
            self.located = False  # until it is known where the manipulator is
            try:
                self._make_good()
            except Exception as error:  # noqa: BLE001 - the client is told, the fault stays
                self._board.detail = str(error)
            else:
                self.located = True
                self.fault = Fault.NONE
                self._controller.latch(Fault.NONE)
                self._lateness.reset()
                words[Word.FAULT] = Fault.NONE
                self._board.detail = ""
                self._begin_self_test()
            finally:
                gc.collect()  # what failing left behind: nobody else does, and here is time
                words[Word.BUSY] = 0
                self._silent = 0
        words[Word.CLEARED] = request

    def _begin_self_test(self) -> None:
        self._left, self._tries = self._test_cycles, _TESTS
        self._rest(State.SELF_TEST)
        self.advance = self._self_test

    def _label(self, log: int) -> None:
        self.tag = log
        self._words[Word.LOG] = log
