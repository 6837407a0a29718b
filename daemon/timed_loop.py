"""The loop in real time: wait, look, sync, read, control, write, record; alone in its process.

What a cycle looks at are words in shared memory. It takes no lock, allocates no memory, writes no
file and asks nobody: whatever happens to the supervisor, the recorder, the disk or a client, the
next cycle begins on time, or the coils are at zero.
"""

from __future__ import annotations

import contextlib
import gc
import os
import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ..config.rig import RigConfig
from ..drivers.base import Devices
from .board import Word
from .clock import Clock
from .control import Controller
from .failures import fault_of
from .faults import Fault
from .landing import Landing, Motion
from .lateness import Lateness
from .program import Announced
from .ring import NO_LOG
from .segment import Segment
from .self_test import self_test
from .shared import Shared
from .states import State
from .timing import account, memory_of
from .warm_up import resting_segment

_AFTER_FAULT_S = 0.5
_COUNT_EVERY = 63
"""Cycles between two looks at slow counters, less one; a mask."""
_TESTS = 10
"""How often the self-test is tried before it has failed."""
_MOST_AT_ONCE = 8
"""Periods that one look at the supervisor's sign of life counts."""
_AROUND_CLEAR = 2
"""Cycles that do not count as late or long: one in which a clear was seen to, and the next."""
_FLYING = np.ones((1, 3))
_FOREVER = 1 << 62
# Indexing by an IntEnum costs a call; by a plain integer it does not.
(
    _BEAT, _LAND, _ZERO, _CLEAR, _END, _CYCLE, _STALE, _ROWS_HEAD, _ROWS_TAIL,
    _QUEUE_HEAD, _QUEUE_TAIL, _LATE, _STOPPED,
) = (
    int(word)
    for word in (
        Word.BEAT, Word.LAND, Word.ZERO, Word.CLEAR, Word.END, Word.CYCLE, Word.STALE,
        Word.ROWS_HEAD, Word.ROWS_TAIL, Word.QUEUE_HEAD, Word.QUEUE_TAIL, Word.LATE,
        Word.SUPERVISOR_STOPPED,
    )
)  # fmt: skip


class TimedLoop:
    """Flies the program in shared memory on open devices until it is told to end.

    Without a segment to fly it stands: at zero force if control is off, else holding the platform
    where it is. `recover` makes devices good after a fault; it may take long.
    """

    def __init__(
        self,
        rig: RigConfig,
        controller: Controller,
        devices: Devices,
        clock: Clock,
        shared: Shared,
        recover: Callable[[], None],
        parent: int,
    ) -> None:
        self._rig, self._period_s = rig, 1.0 / rig.rate_hz
        self._controller, self._devices, self._clock = controller, devices, clock
        self._board, self._ring, self._program = shared.board, shared.ring, shared.program
        self._words, self._recover, self._parent = shared.board.words, recover, parent
        self._counts, self._before = shared.timing.counts, memory_of(1e9 / rig.rate_hz)
        self._lateness = Lateness(rig.limits, rig.rate_hz)
        # A loop that follows a dead one counts on.
        self._lateness.late, self._stale_before = shared.board[Word.LATE], shared.board[Word.STALE]
        self._landing = Landing(controller, rig.limits, self._period_s)
        self._test_cycles = max(round(rig.self_test.duration_s * rig.rate_hz), 2)
        self._most_silent = max(round(rig.service.supervisor_s * rig.rate_hz), 2)

        words = self._words
        self.cycle = words[_CYCLE]
        self._state = State.OFF
        self._fault = Fault.NONE
        self._beat, self._silent = words[_BEAT], 0
        self._land_seen, self._clear_seen = words[_LAND], words[_CLEAR]
        self._after_landing: tuple[Fault, str] | None = None
        self._ending, self._ended = False, False
        self._orphan = False
        self._located = True  # and may be told where to be
        self._tag = NO_LOG
        self._tagged_left = _FOREVER
        self._k = self._left = self._tries = 0
        self._position = self._uncounted = 0
        self._announced: Announced | None = None
        self._advance = self._stand

    def run(self) -> None:
        """Begin with a self-test; return when the board says to end, coils at zero force."""
        self._words[Word.CLEARED] = self._clear_seen
        self._begin_self_test()
        while not self._ended:
            try:
                self._cycles()
            except Exception as error:  # noqa: BLE001 - whatever it is, the coils go to zero first
                self._raised(error)
        self._zero()
        self._become(State.OFF)

    def _cycles(self) -> None:
        """Fly cycle after cycle, until the end or until something raises."""
        control, ring, devices = self._controller, self._ring, self._devices
        amplifiers, sensors, drives = devices.amplifiers, devices.sensors, devices.drives
        syncs, step, rows, capacity = devices.syncs, control.step, ring.rows, ring.capacity
        gap, readback, coil = control.gap_m, control.readback_n, control.coil_n
        beam, rotor, beam_ref, rotor_ref = (
            control.beam, control.rotor, control.beam_ref, control.rotor_ref,
        )  # fmt: skip
        lateness, execution, skips = rows["lateness_s"], rows["execution_s"], rows["skipped"]
        stales = rows["stale"]
        tags, words, clock, period_s = ring.tags, self._words, self._clock, self._period_s
        wait, now, look, late = clock.wait, time.perf_counter_ns, self._look, self._lateness
        counts, before, head = self._counts, self._before, ring.head
        while not self._ended:
            late_s = wait()
            begin = now()
            skipped = clock.skipped
            cycle = self.cycle = self.cycle + 1 + skipped
            words[_CYCLE] = cycle
            look(1 + skipped)
            uncounted = self._uncounted and self._count_down()
            if uncounted == _AROUND_CLEAR:  # it took as long as homing does
                begin = now()
            if not cycle & _COUNT_EVERY:
                words[_STALE], words[_LATE] = self._stale_before + devices.stale, late.late
            k = self._advance()
            for sync in syncs:
                sync(cycle)
            sensors.read(gap)
            drives.read(beam, rotor)
            amplifiers.read(readback)
            read = now()
            slot = head % capacity
            fault = step(rows, slot, cycle, cycle * period_s, k)
            if not uncounted and late.too_much(skipped) and not fault and control.engaged:
                fault = self._too_late(slot)
            computed = now()
            amplifiers.write(coil)
            if self._located:
                drives.write(beam_ref, rotor_ref)
            tags[slot] = self._tag
            lateness[slot] = late_s
            skips[slot] = min(skipped, 255)
            if sensors.stale or drives.stale or amplifiers.stale:
                stales[slot] = devices.stale_roles
            ended = now()
            execution[slot] = (ended - begin) * 1e-9
            head += 1
            ring.head = head
            if not uncounted:
                account(
                    counts, late_s * 1e9, read - begin, computed - read, ended - computed, skipped,
                    before,
                )  # fmt: skip
            if fault:
                self._fail(Fault(fault), control.detail(Fault(fault)))

    def _too_late(self, slot: int) -> int:
        """End control in the cycle at hand, whose row is there; return the fault."""
        self._controller.halt()
        rows = self._ring.rows
        rows["coil_n"][slot] = 0.0
        rows["state"][slot], rows["fault"][slot] = State.FAULT, Fault.LATE
        return int(Fault.LATE)

    def _count_down(self) -> int:
        """Return how many of the cycles around a clear there are, this one included."""
        self._uncounted -= 1
        return self._uncounted + 1

    def _look(self, periods: int) -> None:
        """Notice what others want, and whether the supervisor is there to want anything."""
        words = self._words
        self._look_after_supervisor(periods)
        if words[_ZERO] and not self._fault:
            self._fail(Fault(words[_ZERO]), None)  # who asks has said why
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
            self._ended = self._tagged_left == _FOREVER
            if self._ended and words[Word.PLAN]:
                self._end_plan()

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
        if words[_STOPPED]:
            self._abandoned("it is stopped")
        if os.getppid() != self._parent and not self._orphan:
            self._orphan = True
            self._abandoned("it is dead")

    # What row of which arrays the next cycle flies; one of these is `_advance`.

    def _stand(self) -> int:
        """Hold, or rest at zero force; begin the next segment if one is announced."""
        words = self._words
        if words[_QUEUE_TAIL] < words[_QUEUE_HEAD]:
            self._next_segment()
            if self._advance != self._stand:
                return self._advance()
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
                return self._advance()
        position = self._position
        if position >= words[_ROWS_HEAD]:
            self._starved("it left the loop without rows to fly")
            return self._advance()
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
            self._advance = self._stand
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
            self._fail(Fault.SELF_TEST, wrong)
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
        unwanted = self._fault or (self._ending and not going_on)
        if unwanted or announced.plan <= words[Word.PLAN_CUT]:
            words[Word.PLAN_CUT] = max(announced.plan, words[Word.PLAN_CUT])
            if not going_on:  # else its last rows are still to come
                words[Word.PLAN_DONE] = max(announced.plan, words[Word.PLAN_DONE])
            self._advance = self._stand
            return
        if self._begin(self._program.segment(announced)):
            words[Word.PLAN] = announced.plan
            self._announced = announced
            self._label(announced.log)
            self._left, self._position = announced.cycles, announced.first
            self._advance = self._fly_program

    def _begin(self, segment: Segment) -> bool:
        """Hand a segment to control; refuse one that may not follow."""
        if not self._state.may_become(segment.state):
            self._fail(Fault.SEQUENCE, f"{segment.state.name} after {self._state.name}")
            return False
        if segment.engages:
            self._lateness.forget()  # what was late at zero force harmed nobody
        self._controller.begin(segment)
        self._become(segment.state)
        return True

    def _rest(self, state: State, motion: Motion | None = None) -> None:
        """Stand at zero force in `state`, the manipulator at rest, or in `motion` of its own."""
        resting = resting_segment(self._controller, _FOREVER)
        if motion is not None:
            resting = replace(resting, beam=motion[0], rotor=motion[1])
        self._begin(replace(resting, state=state))
        self._advance = self._stand

    def _hold(self) -> None:
        """Hold the platform, and the manipulator at rest, until told otherwise."""
        resting = resting_segment(self._controller, _FOREVER)
        self._begin(
            replace(resting, state=State.LEVITATING, blend=_FLYING, in_control=True, airborne=True)
        )
        self._advance = self._stand

    def _land(self) -> None:
        """Land from here; without control there is nothing to land, only a plan to drop."""
        words = self._words
        if self._state is State.LANDING:
            if not words[Word.PLAN]:  # a move that came as this began is not for the ground
                words[Word.PLAN_CUT] = max(words[Word.PLAN_CUT], self._last_announced)
            return
        words[Word.PLAN_CUT] = max(words[Word.PLAN], words[Word.PLAN_CUT], self._last_announced)
        if self._fault:
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
            self._advance = self._fly_landing

    def _end_plan(self) -> None:
        """The plan at hand is over: its rows end here."""
        words = self._words
        words[_LATE] = self._lateness.late  # whoever sees the plan's end counts up to it
        words[Word.PLAN_DONE] = max(words[Word.PLAN], words[Word.PLAN_DONE])
        words[Word.PLAN] = 0
        self._tagged_left = _FOREVER
        if self._fault:
            self._label(NO_LOG)
        elif self._state is not State.LANDING and self._controller.engaged:
            self._hold()  # it goes on flying, and the log with it
        else:
            self._label(NO_LOG)
            self._rest(State.IDLE)
            after, self._after_landing = self._after_landing, None
            if after is not None:
                self._fail(*after)

    def _starved(self, why: str) -> None:
        """The plan goes on and its rows are not there."""
        self._left = 0
        self._abandoned(why)
        if self._advance != self._fly_program:
            return
        # At zero force it is enough to drop the plan; who was about to land anyway goes on landing.
        words = self._words
        words[Word.PLAN_CUT] = max(words[Word.PLAN], words[Word.PLAN_CUT])
        announced = self._announced
        if self._controller.engaged and self._state is State.LANDING and announced is not None:
            blend = self._program.segment(announced).blend
            self._land_unplanned(after=blend[(self._position - 1) % len(blend)])
        else:
            self._end_plan()

    def _abandoned(self, why: str) -> None:
        """The supervisor is gone: land or let go, as configured."""
        if self._fault or self._after_landing is not None:
            return
        if self._rig.service.supervisor_gone == "land" and self._controller.engaged:
            self._after_landing = Fault.SUPERVISOR, why
            self._land()
        elif self._controller.engaged or self._orphan:
            self._fail(Fault.SUPERVISOR, why)

    def _fail(self, fault: Fault, detail: str | None = "") -> None:
        """Zero force from here on; what came first is the cause."""
        control, words = self._controller, self._words
        control.halt()
        if self._fault:
            return
        self._fault, self._after_landing = fault, None
        control.latch(fault)
        if detail is not None:
            self._board.detail = detail
        words[Word.FAULT_CYCLE] = self.cycle
        words[Word.FAULT_PLAN] = words[Word.PLAN]
        words[Word.FAULT_LOG] = self._tag
        words[Word.FAULT] = fault
        words[Word.PLAN_CUT] = max(words[Word.PLAN], words[Word.PLAN_CUT])
        self._tagged_left = max(round(_AFTER_FAULT_S * self._rig.rate_hz), 1)
        self._rest(State.FAULT, self._landing.brake())
        self._k, self._advance = 0, self._brake

    def _raised(self, error: Exception) -> None:
        """Zero force before anyone is told; then a row of the log that names the fault."""
        fault, detail = fault_of(error)
        harmless = not self._controller.engaged and self._state is not State.SELF_TEST
        # Every time: what was sent before may have been lost, on a bus that loses frames.
        self._zero()
        if self._fault:
            self._controller.move(0)
        elif fault is not Fault.STALE or not harmless:  # else they are counted, and harm nobody
            self._fail(fault, detail)
            ring, slot = self._ring, self._ring.head % self._ring.capacity
            self._controller.step(ring.rows, slot, self.cycle, self.cycle * self._period_s, 0)
            ring.rows["fault"][slot] = fault
            ring.rows["state"][slot] = State.FAULT
            ring.rows["stale"][slot] = self._devices.stale_roles
            ring.tags[slot] = self._tag
            ring.head += 1
            self._k += 1  # this is the first cycle that brakes
        # Who is silent may be another: drives that are told nothing stop dead, or go on.
        if self._located:
            with contextlib.suppress(Exception):
                self._devices.drives.write(self._controller.beam_ref, self._controller.rotor_ref)

    def _zero(self) -> None:
        """Command zero force, as well as the devices still allow."""
        self._controller.halt()
        with contextlib.suppress(
            Exception
        ):  # a bus that is gone: the devices' own expiry has to do
            self._devices.amplifiers.release(self._controller.coil_n)

    def _clear(self, request: int) -> None:
        """Make the devices good, then test; may take long, at zero force."""
        self._clear_seen = request
        words = self._words
        if self._fault:
            words[_ZERO] = 0  # nobody but who has stopped takes a stop back
            if self._tagged_left < _FOREVER:
                self._end_plan()  # its story ends here
            words[Word.BUSY] = 1
            self._uncounted = _AROUND_CLEAR
            self._located = False  # until it is known where the manipulator is
            try:
                self._recover()
            except Exception as error:  # noqa: BLE001 - the client is told, the fault stays
                self._board.detail = str(error)
                with contextlib.suppress(Exception):
                    self._devices.drives.release()  # some may be on, and nobody knows where
            else:
                self._located = True
                self._fault = Fault.NONE
                self._controller.latch(Fault.NONE)
                self._lateness.forget()
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
        self._advance = self._self_test

    def _label(self, log: int) -> None:
        self._tag = log
        self._words[Word.LOG] = log

    def _become(self, state: State) -> None:
        self._state = state
        self._words[Word.STATE] = state
