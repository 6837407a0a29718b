"""State machine of the loop: fly a segment, land, test or send zero force.

Its inputs are control words in shared memory. It takes no lock, writes no file and waits for no
process.
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
from ..control.flight_segment import Segment
from ..control.landing import Landing, Motion
from ..control.late_cycle_detector import Lateness
from ..control.self_test import self_test
from ..control.standing_readings import LEAST_ROWS
from ..control.states import State, may_become
from ..ipc.flight_segment_stream import Announced
from ..ipc.memory_fences import acquire, release
from ..ipc.row_ring import NO_LOG
from ..ipc.shared_memory import SharedMemory
from ..ipc.shared_status_words import Word
from .prepare_first_cycle import resting_segment

AROUND_CLEAR = 2
"""Cycles that never count as late: the one that handles a request to clear, and the next one."""
_AFTER_FAULT_S = 0.5
_TESTS = 10
"""Tries of the self-test before it fails."""
_MAX_SILENT_PER_CYCLE = 8
"""Largest number of skipped periods that count as supervisor silence in one cycle."""
_FULL_BLEND = np.ones((1, 3))
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


class StateMachine:
    """Select the segment row of each cycle for TimedLoop: `check_requests`, then `advance`.

    Without a segment it idles at zero force if control is off, otherwise it holds the platform.
    `recover` recovers the devices after a fault; it may take long. `advance` returns the next row
    of the segment's arrays; it is bound to the method of the current activity.
    """

    def __init__(
        self,
        rig: RigConfig,
        controller: Controller,
        shared: SharedMemory,
        lateness: Lateness,
        recover: Callable[[], None],
        parent: int,
    ) -> None:
        self._rig, self._controller, self._lateness = rig, controller, lateness
        self._control_words, self._ring, self._segment_stream = (
            shared.control_words,
            shared.ring,
            shared.segment_stream,
        )
        self._words, self._recover, self._parent = shared.control_words.words, recover, parent
        self._landing = Landing(controller, rig.limits, 1.0 / rig.rate_hz)
        # Half of the readings may be missing.
        self._test_cycles = max(round(rig.self_test.duration_s * rig.rate_hz), 2 * LEAST_ROWS)
        self._silence_limit = max(round(rig.service.supervisor_s * rig.rate_hz), 2)

        words = self._words
        self.state = State.OFF
        self.fault = Fault.NONE
        self.ended = False
        self.tag = NO_LOG
        """Tag of the log of the current row."""
        self.located = True
        """Whether the manipulator position is known, so that setpoints may be sent."""
        self.uncounted = 0
        """Remaining cycles that do not count as late."""
        self.advance: Callable[[], int] = self._idle
        self._beat, self._silent = words[_BEAT], 0
        self._land_request, self._clear_request = words[_LAND], words[_CLEAR]
        self._after_landing: tuple[Fault, str] | None = None
        self._ending = self._parent_died = False
        self._tagged_left = _FOREVER
        self._k = self._left = self._tries = self._position = 0
        self._announced: Announced | None = None

    def begin(self) -> None:
        """Start with a self-test at zero force."""
        self._words[Word.CLEARED] = self._clear_request
        self._begin_self_test()

    def count_down(self) -> int:
        """Decrement `uncounted`; return its previous value."""
        self.uncounted -= 1
        return self.uncounted + 1

    def check_requests(self, periods: int) -> None:
        """Handle requests in the control words; check the supervisor's heartbeat."""
        words = self._words
        self._check_supervisor(periods)
        if words[_ZERO] and not self.fault:
            self.fail(Fault(words[_ZERO]), None)  # the requesting process has set the detail
        if words[_LAND] != self._land_request:
            self._land_request = words[_LAND]
            self._land()
        if words[_CLEAR] != self._clear_request:
            self._clear(words[_CLEAR])
        if words[_END] and not self._ending:
            self._ending = True
            self._land()
        if self._tagged_left < _FOREVER:
            self._tagged_left -= periods
            if self._tagged_left <= 0:
                self._end_plan()
        if (self._ending or self._parent_died) and not self._controller.engaged:
            # The half second after a fault belongs to its recording.
            self.ended = self._tagged_left == _FOREVER
            if self.ended and words[Word.PLAN]:
                self._end_plan()

    def fail(self, fault: Fault, detail: str | None = "") -> None:
        """Command zero force from now on; the first fault is the one reported."""
        control, words = self._controller, self._words
        control.halt()
        if self.fault:
            return
        self.fault, self._after_landing = fault, None
        control.latch(fault)
        if detail is not None:
            self._control_words.detail = detail
        words[Word.FAULT_CYCLE] = words[_CYCLE]
        words[Word.FAULT_PLAN] = words[Word.PLAN]
        words[Word.FAULT_LOG] = self.tag
        words[Word.FAULT] = fault
        words[Word.PLAN_CUT] = max(words[Word.PLAN], words[Word.PLAN_CUT])
        self._tagged_left = max(round(_AFTER_FAULT_S * self._rig.rate_hz), 1)
        self._rest(State.FAULT, self._landing.brake())
        self._k, self.advance = 0, self._brake

    def become(self, state: State) -> None:
        """Enter `state` and publish it."""
        self.state = state
        self._words[Word.STATE] = state

    def _check_supervisor(self, periods: int) -> None:
        words = self._words
        beat = words[_BEAT]
        if beat != self._beat:
            self._beat, self._silent = beat, 0
        else:
            # If the whole machine stalled, the supervisor could not send a heartbeat either.
            self._silent += min(periods, _MAX_SILENT_PER_CYCLE)
            if self._silent > self._silence_limit:
                self._supervisor_lost("no heartbeat")
        if os.getppid() != self._parent and not self._parent_died:
            self._parent_died = True
            self._supervisor_lost("the process has ended")

    # Each returns the row of the next cycle; `advance` is one of these methods.

    def _idle(self) -> int:
        """Hold, or rest at zero force; start the next announced segment."""
        words = self._words
        if words[_QUEUE_TAIL] < words[_QUEUE_HEAD]:
            if not self._next_segment():
                words[_QUEUE_TAIL] = words[_QUEUE_HEAD]
                self.fail(Fault.SUPERVISOR, "the segment it announced is damaged")
            if self.advance != self._idle:
                return self.advance()
        return 0

    def _fly_program(self) -> int:
        """Fly the next row of the current segment, or the first of the next segment."""
        words = self._words
        if not self._left:
            announced = self._announced
            assert announced is not None
            if announced.last:
                self._end_plan()
            elif words[_QUEUE_TAIL] >= words[_QUEUE_HEAD]:
                self._program_ended("it announced no further segment")
            elif not self._next_segment():
                self._program_ended("the segment it announced is damaged")
            if not self._left:
                return self.advance()
        position = self._position
        if position >= words[_ROWS_HEAD]:
            self._program_ended("it sent no further rows")
            return self.advance()
        acquire()
        self._left -= 1
        self._position = position + 1
        release()
        words[_ROWS_TAIL] = position
        return position % self._segment_stream.capacity

    def _fly_landing(self) -> int:
        """Fly the next row of an unplanned landing."""
        if not self._landing.set_row(self._k):
            self._end_plan()
            return 0
        self._k += 1
        return 0

    def _brake(self) -> int:
        """Brake the manipulator at zero force, then rest."""
        if not self._landing.set_motion(self._k):
            self.advance = self._idle
        self._k += 1
        return 0

    def _self_test(self) -> int:
        """Rest for the cycles of the test, then check their readings."""
        self._left -= 1
        if self._left > 0:
            return 0
        rows = self._ring.last(self._test_cycles - 1).rows
        rows = rows[rows["state"] == State.SELF_TEST]
        error = self_test(rows, self._rig) or self._controller.learn_rest(rows)
        self._tries -= 1
        if not error:
            self._rest(State.IDLE)
        elif self._tries:
            self._left = self._test_cycles  # a platform that just dropped needs time to settle
        else:
            self.fail(Fault.SELF_TEST, error)
        return 0

    # Transitions between cycles.

    def _next_segment(self) -> bool:
        """Take the next segment from the queue; return False if it is not there as announced."""
        words = self._words
        number = words[_QUEUE_TAIL]
        announced = self._segment_stream.announced(number)
        if announced is None:
            return False
        release()
        words[_QUEUE_TAIL] = number + 1
        self._left = 0
        same_plan = announced.plan == words[Word.PLAN]
        # When ending, start no other plan, but continue the landing of the current plan.
        rejected = self.fault or (self._ending and not same_plan)
        if rejected or announced.plan <= words[Word.PLAN_CUT]:
            words[Word.PLAN_CUT] = max(announced.plan, words[Word.PLAN_CUT])
            if not same_plan:  # otherwise its last rows follow
                words[Word.PLAN_DONE] = max(announced.plan, words[Word.PLAN_DONE])
            self.advance = self._idle
            return True
        if self._begin(self._segment_stream.segment(announced)):
            words[Word.PLAN] = announced.plan
            self._announced = announced
            self._set_tag(announced.log)
            self._left, self._position = announced.cycles, announced.first
            self.advance = self._fly_program
        return True

    def _begin(self, segment: Segment) -> bool:
        """Pass a segment to the controller; fail if its state must not follow the present one."""
        if not may_become(self.state, segment.state):
            self.fail(Fault.SEQUENCE, f"{segment.state.name} after {self.state.name}")
            return False
        if segment.engages:
            self._lateness.reset()  # late cycles at zero force do not count
        self._controller.begin(segment)
        self.become(segment.state)
        return True

    def _rest(self, state: State, motion: Motion | None = None) -> None:
        """Rest at zero force in `state`, with the manipulator at rest or in `motion`."""
        resting = resting_segment(self._controller, _FOREVER)
        if motion is not None:
            resting = replace(resting, beam=motion[0], rotor=motion[1])
        self._begin(replace(resting, state=state))
        self.advance = self._idle

    def _hold(self) -> None:
        """Hold the platform and the manipulator until the next segment or request."""
        resting = resting_segment(self._controller, _FOREVER)
        self._begin(
            replace(
                resting, state=State.LEVITATING, blend=_FULL_BLEND, in_control=True, airborne=True
            )
        )
        self.advance = self._idle

    def _land(self) -> None:
        """Land from here; if control is off, only drop the plan."""
        words = self._words
        if self.state is State.LANDING:
            if not words[Word.PLAN]:  # drop a move that was announced as the landing started
                words[Word.PLAN_CUT] = max(words[Word.PLAN_CUT], self._last_announced)
            return
        words[Word.PLAN_CUT] = max(words[Word.PLAN], words[Word.PLAN_CUT], self._last_announced)
        if self.fault:
            return
        if not self._controller.engaged:
            if words[Word.PLAN]:
                self._end_plan()
            return
        self._land_unplanned()

    @property
    def _last_announced(self) -> int:
        """Plan of the last announced segment that has not started; 0 if none."""
        words = self._words
        head = words[_QUEUE_HEAD]
        announced = self._segment_stream.announced(head - 1) if words[_QUEUE_TAIL] < head else None
        return announced.plan if announced is not None else 0

    def _land_unplanned(self, after: NDArray[np.float64] | None = None) -> None:
        """Fly a landing from here, or continue a planned one from its blend row `after` (3,)."""
        words = self._words
        self._landing.begin(words[Word.LAND_RAMP], words[Word.LAND_RELEASE])
        # A planned landing that has started keeps its start reference.
        if self._begin(replace(self._landing.segment, lands=after is None)):
            self._set_tag(words[Word.LAND_LOG])
            self._k = 0 if after is None else self._landing.row_after(after)
            self.advance = self._fly_landing

    def _end_plan(self) -> None:
        """End the current plan and its rows; called half a second after a fault."""
        words = self._words
        after = self._after_landing
        landed = self.state is State.LANDING or not self._controller.engaged
        if after is not None and not self.fault and landed:
            self._after_landing = None
            self.fail(*after)  # while the plan is current: its client gets this fault
            return
        words[_LATE] = self._lateness.late  # final before PLAN_DONE
        words[Word.PLAN_DONE] = max(words[Word.PLAN], words[Word.PLAN_DONE])
        words[Word.PLAN] = 0
        self._tagged_left = _FOREVER
        if self.fault:
            self._set_tag(NO_LOG)
        elif self.state is not State.LANDING and self._controller.engaged:
            self._hold()  # flight and log continue
        else:
            self._set_tag(NO_LOG)
            self._rest(State.IDLE)

    def _program_ended(self, reason: str) -> None:
        """Handle a plan that continues but whose rows are missing."""
        self._left = 0
        self._supervisor_lost(reason)
        if self.advance != self._fly_program:
            return
        # At zero force, drop the plan; a landing in progress continues unplanned.
        words = self._words
        words[Word.PLAN_CUT] = max(words[Word.PLAN], words[Word.PLAN_CUT])
        announced = self._announced
        if self._controller.engaged and self.state is State.LANDING and announced is not None:
            blend = self._segment_stream.segment(announced).blend
            self._land_unplanned(after=blend[(self._position - 1) % len(blend)])
        else:
            self._end_plan()

    def _supervisor_lost(self, reason: str) -> None:
        """React to a lost supervisor: land or command zero force, as configured."""
        if self.fault or self._after_landing is not None:
            return
        if self._rig.service.supervisor_gone == "land" and self._controller.engaged:
            self._after_landing = Fault.SUPERVISOR, reason
            self._land()
        elif self._controller.engaged or self._parent_died:
            self.fail(Fault.SUPERVISOR, reason)

    def _clear(self, request: int) -> None:
        """Recover the devices, then start the self-test; may take long, at zero force."""
        self._clear_request = request
        words = self._words
        if self.fault:
            self._control_words.cancel_stop()
            if self._tagged_left < _FOREVER:
                self._end_plan()
            words[Word.BUSY] = 1
            self.uncounted = AROUND_CLEAR
            self.located = False  # until the manipulator position is read
            try:
                self._recover()
            except Exception as error:  # noqa: BLE001 - the client gets the detail; the fault stays
                self._control_words.detail = str(error)
            else:
                self.located = True
                self.fault = Fault.NONE
                self._controller.latch(Fault.NONE)
                self._lateness.reset()
                words[Word.FAULT] = Fault.NONE
                self._control_words.detail = ""
                self._begin_self_test()
            finally:
                gc.collect()  # automatic collection is disabled; there is time here
                words[Word.BUSY] = 0
                self._silent = 0
        words[Word.CLEARED] = request

    def _begin_self_test(self) -> None:
        self._left, self._tries = self._test_cycles, _TESTS
        self._rest(State.SELF_TEST)
        self.advance = self._self_test

    def _set_tag(self, log: int) -> None:
        self.tag = log
        self._words[Word.LOG] = log
