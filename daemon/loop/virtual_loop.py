"""Run the control loop in virtual time: sync, read, control, write, record."""

from __future__ import annotations

from collections.abc import Callable

from ...drivers.base import Devices
from ..control.control_cycle import Controller
from ..control.exception_to_fault import fault_of
from ..control.faults import Fault
from ..control.flight_segment import Segment
from ..control.standing_readings import MOST_ROWS
from ..control.states import State, may_become
from ..ipc.row_ring import NO_LOG, Ring

_BLOCK = 4096


class VirtualLoop:
    """Fly segments on open devices as fast as the code runs; write one tagged ring row per cycle.

    `cycle` counts periods since the start: cycle times period is the time of the plant. The
    counterpart in real time is TimedLoop.
    """

    def __init__(
        self,
        controller: Controller,
        devices: Devices,
        ring: Ring,
        period_s: float,
        make_room: Callable[[int], None],
    ) -> None:
        self._controller, self._devices = controller, devices
        self._ring, self._period_s, self._make_room = ring, period_s, make_room
        self._state = State.IDLE
        self.cycle = -1
        self.tag = NO_LOG
        self.stop_requested = False
        self.detail = ""

    def fly(self, segment: Segment) -> Fault:
        """Fly one segment to its end, a stop request, or a fault; return the fault.

        A landing ignores stop requests.
        """
        stoppable = not segment.lands
        self.detail = ""
        if not may_become(self._state, segment.state):
            self.detail = f"{segment.state.name} after {self._state.name}"
            return self._failed(Fault.SEQUENCE)
        self._state = segment.state
        if segment.engages:  # there is no self-test in virtual time
            rows = self._ring.last(MOST_ROWS).rows
            self._controller.learn_rest(rows[rows["state"] == State.IDLE])
        self._controller.begin(segment)
        fault = 0
        try:
            for begin in range(0, segment.cycles, _BLOCK):
                block = min(_BLOCK, segment.cycles - begin)
                # Virtual time is faster than the disk: only here does the loop wait for the
                # recorder.
                self._make_room(block)
                self._label(block)
                fault = self._block(begin, begin + block, stoppable)
                if fault or (self.stop_requested and stoppable):
                    break
        except Exception as error:  # noqa: BLE001 - on any error the coils go to zero first
            return self._failed(*fault_of(error))
        return Fault(fault)

    def zero(self) -> None:
        """Command zero force as far as the devices respond."""
        self._controller.halt()
        try:
            self._devices.amplifiers.release(self._controller.coil_n)
        except Exception as error:  # noqa: BLE001 - the present fault is more important
            self.detail = self.detail or f"{type(error).__name__}: {error}"

    def _failed(self, fault: Fault, detail: str = "") -> Fault:
        """Command zero force first, then write a log row with the fault."""
        self.zero()
        self.detail = detail or self.detail
        ring, control = self._ring, self._controller
        if ring.room:
            slot = ring.head % ring.capacity
            stale = self._devices.stale_roles
            control.step(ring.rows, slot, self.cycle, self.cycle * self._period_s, 0, 0.0, stale)
            ring.rows["fault"][slot] = fault
            ring.rows["state"][slot] = State.FAULT
            ring.tags[slot] = self.tag
            ring.head += 1
        return fault

    def _label(self, rows: int) -> None:
        """Tag the next rows before they are written."""
        ring = self._ring
        first = ring.head % ring.capacity
        ring.tags[first : first + rows] = self.tag
        ring.tags[: max(first + rows - ring.capacity, 0)] = self.tag

    def _block(self, begin: int, end: int, stoppable: bool) -> int:
        control, ring, devices = self._controller, self._ring, self._devices
        amplifiers, sensors, drives = devices.amplifiers, devices.sensors, devices.drives
        syncs, step, rows, capacity = devices.syncs, control.step, ring.rows, ring.capacity
        gap, readback, coil = control.gap_m, control.readback_n, control.coil_n
        beam, rotor, beam_ref, rotor_ref = (
            control.beam, control.rotor, control.beam_ref, control.rotor_ref,
        )  # fmt: skip
        cycle, head, period_s = self.cycle, ring.head, self._period_s
        fault = 0
        try:
            for k in range(begin, end):
                cycle += 1
                for sync in syncs:
                    sync(cycle)
                sensors.read(gap)
                drives.read(beam, rotor)
                amplifiers.read(readback)
                stale = sensors.stale | drives.stale | amplifiers.stale
                fault = step(rows, head % capacity, cycle, cycle * period_s, k, 0.0, stale)
                amplifiers.write(coil)
                drives.write(beam_ref, rotor_ref)
                head += 1
                if fault or (self.stop_requested and stoppable):
                    break
        finally:  # rows before a driver failure stay in the log
            self.cycle, ring.head = cycle, head
        return fault
