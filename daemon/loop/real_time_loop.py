"""The loop in real time: wait, look, sync, read, control, write, record; alone in its process.

What a cycle looks at are words in shared memory. It takes no lock, allocates no memory, writes no
file and asks nobody: whatever happens to the supervisor, the recorder, the disk or a client, the
next cycle begins on time, or the coils are at zero.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable

from ...config.rig import RigConfig
from ...drivers.base import Devices
from ..control.control_cycle import Controller
from ..control.detection_times import longest_stall
from ..control.exception_faults import fault_of
from ..control.faults import Fault
from ..control.lateness import Lateness
from ..control.states import State
from ..ipc.control_words import Word
from ..ipc.shared_memory import Shared
from ..ipc.timing_histograms import account, count_wake_up, memory_of
from .clock import Clock
from .state_machine import AROUND_CLEAR, Course

_COUNT_EVERY = 63
"""Cycles between two looks at slow counters, less one; a mask."""
# Indexing by an IntEnum costs a call; by a plain integer it does not.
_CYCLE, _STALE, _LATE = int(Word.CYCLE), int(Word.STALE), int(Word.LATE)


class TimedLoop:
    """Flies a course on open devices until it is told to end.

    `recover` makes devices good after a fault; it may take long.
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
        self._period_s = 1.0 / rig.rate_hz
        self._longest_ns = round((longest_stall(rig) + 1) * 1e9 / rig.rate_hz)
        self._controller, self._devices, self._clock = controller, devices, clock
        self._ring, self._words, self._recover = shared.ring, shared.board.words, recover
        self._counts, self._before = shared.timing.counts, memory_of(1e9 / rig.rate_hz)
        self._wake_ups = shared.wake_ups.counts
        count_wake_up(self._wake_ups, -1)  # compiles it
        self._lateness = Lateness(rig.limits, rig.rate_hz, longest_stall(rig))
        # A loop that follows a dead one counts on.
        self._lateness.late, self._stale_before = shared.board[Word.LATE], shared.board[Word.STALE]
        self.cycle = shared.board[Word.CYCLE]
        self.course = Course(rig, controller, shared, self._lateness, self._make_good, parent)

    def run(self) -> None:
        """Begin with a self-test; return when the board says to end, coils at zero force."""
        course = self.course
        course.begin()
        while not course.ended:
            try:
                self._cycles()
            except Exception as error:  # noqa: BLE001 - whatever it is, the coils go to zero first
                self._raised(error)
        self._zero()
        course.become(State.OFF)

    def _cycles(self) -> None:  # noqa: PLR0915 - one cycle, in its order
        """Fly cycle after cycle, until the end or until something raises."""
        control, ring, devices = self._controller, self._ring, self._devices
        amplifiers, sensors, drives = devices.amplifiers, devices.sensors, devices.drives
        syncs, step, rows, capacity = devices.syncs, control.step, ring.rows, ring.capacity
        gap, readback, coil = control.gap_m, control.readback_n, control.coil_n
        beam, rotor, beam_ref, rotor_ref = (
            control.beam, control.rotor, control.beam_ref, control.rotor_ref,
        )  # fmt: skip
        lateness, execution, skips, stales = (
            rows["lateness_s"], rows["execution_s"], rows["skipped"], rows["stale"],
        )  # fmt: skip
        tags, words, clock, period_s = ring.tags, self._words, self._clock, self._period_s
        wait, now, late, course = clock.wait, time.perf_counter_ns, self._lateness, self.course
        counts, wake_ups, before, head, look = (
            self._counts, self._wake_ups, self._before, ring.head, course.look,
        )  # fmt: skip
        longest_ns = self._longest_ns
        while not course.ended:
            late_s = wait()
            begin, skipped = now(), clock.skipped
            cycle = self.cycle = self.cycle + 1 + skipped
            words[_CYCLE] = cycle
            look(1 + skipped)
            uncounted = course.uncounted and course.count_down()
            if uncounted == AROUND_CLEAR:  # it took as long as homing does
                begin = now()
            # Before anything is read: a loop that stood still for too long sends no force any more.
            if not uncounted and late.exceeded(skipped) and control.engaged:
                course.fail(Fault.LATE, late.reason)
            if not head & _COUNT_EVERY:  # rows, not cycles: periods that are skipped may never hit
                words[_STALE], words[_LATE] = self._stale_before + devices.stale, late.late
            k = course.advance()
            chosen = now()
            for sync in syncs:
                sync(cycle, late_s - skipped * period_s)
            sensors.read(gap)
            drives.read(beam, rotor)
            amplifiers.read(readback)
            read = now()
            slot = head % capacity
            fault = step(
                rows, slot, cycle, cycle * period_s, k,
                late_s - skipped * period_s + (read - begin) * 1e-9,
            )  # fmt: skip
            computed = now()
            if computed - begin > longest_ns and control.engaged:
                self._held_up(slot, 1e-9 * (computed - begin))
            amplifiers.write(coil)
            if course.located:
                drives.write(beam_ref, rotor_ref)
            written = now()
            tags[slot], lateness[slot] = course.tag, late_s
            skips[slot] = min(skipped, 255)
            if sensors.stale or drives.stale or amplifiers.stale:
                stales[slot] = devices.stale_roles
            ended = now()
            execution[slot] = (ended - begin) * 1e-9
            head += 1
            ring.head = head
            if not uncounted:
                account(
                    counts, late_s * 1e9, read - chosen,
                    chosen - begin + computed - read + ended - written, written - computed,
                    skipped, before,
                )  # fmt: skip
                count_wake_up(wake_ups, clock.overslept_ns)
            if fault:
                course.fail(Fault(fault), control.detail(Fault(fault)))

    def _held_up(self, slot: int, seconds: float) -> None:
        """End control in the cycle at hand: its readings are too old to act on."""
        self.course.fail(Fault.LATE, f"a cycle took {seconds:.3g} s until it could write")
        rows = self._ring.rows
        rows["coil_n"][slot] = 0.0
        rows["state"][slot], rows["fault"][slot] = State.FAULT, Fault.LATE

    def _raised(self, error: Exception) -> None:
        """Zero force before anyone is told; then a row of the log that names the fault."""
        fault, detail = fault_of(error)
        course, control = self.course, self._controller
        harmless = not control.engaged and course.state is not State.SELF_TEST
        # Every time: what was sent before may have been lost, on a bus that loses frames.
        self._zero()
        # The cycle publishes them by the rows that it wrote, and this one writes none.
        self._words[_STALE] = self._stale_before + self._devices.stale
        self._words[_LATE] = self._lateness.late
        if course.fault:
            control.move(0)
        elif fault is not Fault.STALE or not harmless:  # else they are counted, and harm nobody
            course.fail(fault, detail)
            ring, slot = self._ring, self._ring.head % self._ring.capacity
            k = course.advance()  # this is the first cycle that brakes
            control.step(ring.rows, slot, self.cycle, self.cycle * self._period_s, k)
            ring.rows["fault"][slot] = fault
            ring.rows["state"][slot] = State.FAULT
            ring.rows["stale"][slot] = self._devices.stale_roles
            ring.tags[slot] = course.tag
            ring.head += 1
        # Who is silent may be another: drives that are told nothing stop dead, or go on.
        if course.located:
            with contextlib.suppress(Exception):
                self._devices.drives.write(control.beam_ref, control.rotor_ref)

    def _zero(self) -> None:
        """Command zero force, as well as the devices still allow."""
        self._controller.halt()
        with contextlib.suppress(Exception):  # a bus is gone: the devices' own expiry has to do
            self._devices.amplifiers.release(self._controller.coil_n)

    def _make_good(self) -> None:
        try:
            self._recover()
        except Exception:
            with contextlib.suppress(Exception):
                self._devices.drives.release()  # some may be on, and nobody knows where
            raise
