"""Run the control loop in real time: wait, check requests, sync, read, control, write, record.

A cycle reads control words in shared memory. It takes no lock, allocates no memory, writes no file
and waits for no process: if the supervisor, the recorder, the disk or a client fails, the next
cycle still starts on time, or the coils are at zero force.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable

from ...config.rig import RigConfig
from ...drivers.base import Devices
from ..control.control_cycle import Controller
from ..control.exception_to_fault import fault_of
from ..control.faults import Fault
from ..control.late_cycle_detector import Lateness
from ..control.states import State
from ..control.watchdog_times import longest_stall
from ..ipc.shared_memory import SharedMemory
from ..ipc.shared_status_words import Word
from .clock import Clock
from .count_cycle_times import account, count_wake_up, memory_of
from .state_machine import AROUND_CLEAR, StateMachine

_COUNT_EVERY = 63
"""Rows between updates of the stale and late counters, minus one; a mask."""
# Indexing by an IntEnum costs a call; by a plain integer it does not.
_DRIVE = int(Fault.DRIVE)
_CYCLE, _STALE, _LATE = int(Word.CYCLE), int(Word.STALE), int(Word.LATE)


class TimedLoop:
    """Run the state machine and the control cycle on open devices until the end is requested.

    `recover` recovers the devices after a fault; it may take long.
    """

    def __init__(
        self,
        rig: RigConfig,
        controller: Controller,
        devices: Devices,
        clock: Clock,
        shared: SharedMemory,
        recover: Callable[[], None],
        parent: int,
    ) -> None:
        self._period_s = 1.0 / rig.rate_hz
        self._longest_ns = round((longest_stall(rig) + 1) * 1e9 / rig.rate_hz)
        self._controller, self._devices, self._clock = controller, devices, clock
        self._ring, self._words, self._recover = shared.ring, shared.control_words.words, recover
        self._counts, self._before = shared.timing.counts, memory_of(1e9 / rig.rate_hz)
        self._wake_ups = shared.wake_ups.counts
        count_wake_up(self._wake_ups, -1)  # compiles it
        self._lateness = Lateness(rig.limits, rig.rate_hz, longest_stall(rig))
        # A restarted loop continues the counts.
        self._lateness.late, self._stale_before = (
            shared.control_words[Word.LATE],
            shared.control_words[Word.STALE],
        )
        self.cycle = shared.control_words[Word.CYCLE]
        self.state_machine = StateMachine(
            rig, controller, shared, self._lateness, self._recover_devices, parent
        )

    def run(self) -> None:
        """Start with a self-test; return at the requested end, coils at zero force."""
        state_machine = self.state_machine
        state_machine.begin()
        while not state_machine.ended:
            try:
                self._cycles()
            except Exception as error:  # noqa: BLE001 - on any error the coils go to zero first
                self._raised(error)
        self._zero()
        state_machine.become(State.OFF)

    def _cycles(self) -> None:  # noqa: PLR0915 - one cycle, in its order
        """Run cycles until the end or an exception."""
        control, ring, devices = self._controller, self._ring, self._devices
        amplifiers, sensors, drives = devices.amplifiers, devices.sensors, devices.drives
        syncs, step, rows, capacity = devices.syncs, control.step, ring.rows, ring.capacity
        gap, readback, coil = control.gap_m, control.readback_n, control.coil_n
        beam, rotor, beam_ref, rotor_ref = (
            control.beam, control.rotor, control.beam_ref, control.rotor_ref,
        )  # fmt: skip
        lateness, execution, skips = rows["lateness_s"], rows["execution_s"], rows["skipped"]
        tags, words, clock, period_s = ring.tags, self._words, self._clock, self._period_s
        wait, now, late, state_machine = (
            clock.wait,
            time.perf_counter_ns,
            self._lateness,
            self.state_machine,
        )
        counts, wake_ups, before, head, check_requests = (
            self._counts, self._wake_ups, self._before, ring.head, state_machine.check_requests,
        )  # fmt: skip
        longest_ns = self._longest_ns
        while not state_machine.ended:
            late_s = wait()
            begin, skipped = now(), clock.skipped
            cycle = self.cycle = self.cycle + 1 + skipped
            words[_CYCLE] = cycle
            check_requests(1 + skipped)
            uncounted = state_machine.uncounted and state_machine.count_down()
            if uncounted == AROUND_CLEAR:  # clearing may have homed drives
                begin = now()
            # Before reading: after a stall beyond the limit, the loop commands zero force.
            if not uncounted and late.exceeded(skipped) and control.engaged:
                state_machine.fail(Fault.LATE, late.reason)
            if not head & _COUNT_EVERY:  # rows, not cycles: skipped periods might miss the mask
                words[_STALE], words[_LATE] = self._stale_before + devices.stale, late.late
            k = state_machine.advance()
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
                sensors.stale | drives.stale | amplifiers.stale,
            )  # fmt: skip
            computed = now()
            if computed - begin > longest_ns and control.engaged:
                self._fail_slow_cycle(slot, 1e-9 * (computed - begin))
            amplifiers.write(coil)
            if state_machine.located:
                drives.write(beam_ref, rotor_ref)
            written = now()
            tags[slot], lateness[slot] = state_machine.tag, late_s
            skips[slot] = min(skipped, 255)
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
                state_machine.fail(Fault(fault), control.detail(Fault(fault)))
                if fault == _DRIVE:  # it must not jump to its setpoint once it is free again
                    with contextlib.suppress(Exception):
                        drives.release()

    def _fail_slow_cycle(self, slot: int, seconds: float) -> None:
        """End control in the current cycle: its readings are too old."""
        self.state_machine.fail(
            Fault.LATE, f"a cycle took {seconds:.3g} s before it wrote the forces"
        )
        rows = self._ring.rows
        rows["coil_n"][slot] = 0.0
        rows["state"][slot], rows["fault"][slot] = State.FAULT, Fault.LATE

    def _raised(self, error: Exception) -> None:
        """Command zero force first, then write a log row with the fault."""
        state_machine, control = self.state_machine, self._controller
        harmless = not control.engaged and state_machine.state is not State.SELF_TEST
        # At each exception: the bus may have lost an earlier frame.
        self._zero()
        fault, detail = fault_of(error)
        # The cycle updates these with its rows, but this one wrote none.
        self._words[_STALE] = self._stale_before + self._devices.stale
        self._words[_LATE] = self._lateness.late
        if state_machine.fault:
            control.move(0)
        elif fault is not Fault.STALE or not harmless:  # stale readings at rest are only counted
            state_machine.fail(fault, detail)
            ring, slot = self._ring, self._ring.head % self._ring.capacity
            k = state_machine.advance()  # the first cycle of braking
            control.step(
                ring.rows, slot, self.cycle, self.cycle * self._period_s, k, 0.0,
                self._devices.stale_roles,
            )  # fmt: skip
            ring.rows["fault"][slot] = fault
            ring.rows["state"][slot] = State.FAULT
            ring.tags[slot] = state_machine.tag
            ring.head += 1
        # Another device may have failed: without setpoints, drives would stop abruptly or go on.
        if state_machine.located:
            with contextlib.suppress(Exception):
                self._devices.drives.write(control.beam_ref, control.rotor_ref)

    def _zero(self) -> None:
        """Command zero force as far as the devices respond."""
        self._controller.halt()
        with contextlib.suppress(Exception):  # bus disconnected: the amplifiers expire
            self._devices.amplifiers.release(self._controller.coil_n)

    def _recover_devices(self) -> None:
        try:
            self._recover()
        except Exception:
            with contextlib.suppress(Exception):
                self._devices.drives.release()  # some may be enabled at an unknown position
            raise
