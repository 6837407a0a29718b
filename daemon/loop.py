"""The timed loop: wait, sync, read, control, write, record; nothing else happens in a cycle."""

from __future__ import annotations

import time
from collections.abc import Callable

from ..config.base import ConfigError
from ..config.rig import Limits
from ..drivers.base import (
    AmplifierError,
    Devices,
    DriveError,
    DriverError,
    LinkError,
    SensorError,
    StaleError,
)
from .clock import Clock
from .control import Controller
from .faults import Fault
from .ring import Ring
from .segment import Segment
from .states import State

_LATE_FORGIVEN = 0.1
"""What a cycle in time takes back of the late cycles that are counted against their limit."""
_BLOCK = 4096
_FAULT_OF = {
    LinkError: Fault.LINK,
    StaleError: Fault.STALE,
    AmplifierError: Fault.AMPLIFIER,
    SensorError: Fault.SENSOR,
    DriveError: Fault.DRIVE,
}


class Loop:
    """Flies segments on open devices, one row of the ring a cycle.

    `cycle` numbers the periods since the start, those that were skipped included, so that cycle
    times the period is the time of the plant.
    """

    def __init__(
        self,
        controller: Controller,
        devices: Devices,
        clock: Clock,
        ring: Ring,
        period_s: float,
        make_room: Callable[[int], None],
        limits: Limits,
    ) -> None:
        self._controller, self._devices, self._clock = controller, devices, clock
        self._ring, self._period_s, self._make_room = ring, period_s, make_room
        self._most_late, self._longest_stall = limits.late_cycles, limits.stall_s / period_s
        self.cycle = -1
        self.late = 0
        self.stop_requested = False
        self.detail = ""

    def fly(self, segment: Segment) -> Fault:
        """Fly one segment to its end, a stop request, or a fault, which is returned.

        A landing goes on to its end whatever is requested: it is what a stop leads to.
        """
        stoppable = not segment.lands
        self.detail = ""  # what an earlier fault said is no cause of the next
        self._controller.begin(segment)
        run = self._in_real_time if self._clock.real else self._in_virtual_time
        try:
            return Fault(run(segment.cycles, stoppable))
        except ConfigError as error:
            # The simulated plant runs effects that users wrote: what fails there is no bus.
            return self._failed(Fault.SIMULATION, str(error))
        except DriverError as error:
            return self._failed(_FAULT_OF.get(type(error), Fault.DRIVER), str(error))
        except Exception as error:  # noqa: BLE001
            return self._failed(Fault.DRIVER, f"{type(error).__name__}: {error}")

    def _failed(self, fault: Fault, detail: str) -> Fault:
        """Zero force before anyone is told, then a row of the log that names the fault."""
        self.zero()
        self.detail = detail
        ring, control = self._ring, self._controller
        if ring.room:
            slot = ring.head % ring.capacity
            control.step(ring.rows, slot, self.cycle, self.cycle * self._period_s, 0)
            ring.rows["fault"][slot] = fault
            ring.rows["state"][slot] = State.FAULT
            ring.rows["stale"][slot] = self._devices.stale_roles
            ring.head += 1
        return fault

    def zero(self) -> None:
        """Command zero force, as well as the devices still allow."""
        self._controller.halt()
        try:
            self._devices.amplifiers.release(self._controller.coil_n)
        except Exception as error:  # noqa: BLE001 - the fault at hand matters more
            self.detail = self.detail or f"{type(error).__name__}: {error}"

    def _in_virtual_time(self, cycles: int, stoppable: bool) -> int:
        fault = 0
        for begin in range(0, cycles, _BLOCK):
            block = min(_BLOCK, cycles - begin)
            # Virtual time outruns any disk: here, and only here, the loop waits for the recorder.
            self._make_room(block)
            fault = self._virtual_block(begin, begin + block, stoppable)
            if fault or (self.stop_requested and stoppable):
                break
        return fault

    def _virtual_block(self, begin: int, end: int, stoppable: bool) -> int:
        control, ring, devices = self._controller, self._ring, self._devices
        amplifiers, sensors, drives = devices.amplifiers, devices.sensors, devices.drives
        syncs, step, rows, capacity = devices.syncs, control.step, ring.rows, ring.capacity
        gap, readback, coil = control.gap_m, control.readback_n, control.coil_n
        beam, rotor, beam_ref, rotor_ref = (
            control.beam, control.rotor, control.beam_ref, control.rotor_ref,
        )  # fmt: skip
        cycle, head, period_s, stales = self.cycle, ring.head, self._period_s, rows["stale"]
        fault = 0
        try:
            for k in range(begin, end):
                cycle += 1
                for sync in syncs:
                    sync(cycle)
                sensors.read(gap)
                drives.read(beam, rotor)
                amplifiers.read(readback)
                fault = step(rows, head % capacity, cycle, cycle * period_s, k)
                if sensors.stale or drives.stale or amplifiers.stale:
                    stales[head % capacity] = devices.stale_roles
                amplifiers.write(coil)
                drives.write(beam_ref, rotor_ref)
                head += 1
                if fault or (self.stop_requested and stoppable):
                    break
        finally:  # what was flown before a driver failed is in the log all the same
            self.cycle, ring.head = cycle, head
        return fault

    def _in_real_time(self, cycles: int, stoppable: bool) -> int:
        control, ring, devices, clock = self._controller, self._ring, self._devices, self._clock
        amplifiers, sensors, drives = devices.amplifiers, devices.sensors, devices.drives
        syncs, step, rows, capacity = devices.syncs, control.step, ring.rows, ring.capacity
        gap, readback, coil = control.gap_m, control.readback_n, control.coil_n
        beam, rotor, beam_ref, rotor_ref = (
            control.beam, control.rotor, control.beam_ref, control.rotor_ref,
        )  # fmt: skip
        lateness, execution, skips = rows["lateness_s"], rows["execution_s"], rows["skipped"]
        stales = rows["stale"]
        period_s, wait, now = self._period_s, clock.wait, time.perf_counter_ns
        fault, late_score, k = 0, 0.0, -1
        most_late, longest_stall = self._most_late, self._longest_stall
        while k < cycles - 1:
            late_s = wait()
            begin = now()
            skipped = clock.skipped
            self.cycle += 1 + skipped
            # The plan waits for what was skipped: a ramp or a move that jumped would be a jolt.
            k += 1
            for sync in syncs:
                sync(self.cycle)
            sensors.read(gap)
            drives.read(beam, rotor)
            amplifiers.read(readback)
            full = ring.head - ring.tail >= capacity
            slot = capacity if full else ring.head % capacity
            fault = step(rows, slot, self.cycle, self.cycle * period_s, k)
            if skipped:
                self.late += 1
                late_score += 1.0
                if (late_score > most_late or skipped > longest_stall) and not fault:
                    fault = int(Fault.LATE)
                    control.halt()
                    rows["fault"][slot] = fault
            elif late_score > 0.0:
                late_score -= _LATE_FORGIVEN
            amplifiers.write(coil)
            drives.write(beam_ref, rotor_ref)
            lateness[slot] = late_s
            skips[slot] = min(skipped, 255)
            if sensors.stale or drives.stale or amplifiers.stale:
                stales[slot] = devices.stale_roles
            execution[slot] = (now() - begin) * 1e-9
            if full:
                ring.lost += 1
            else:
                ring.head += 1
            if fault or (self.stop_requested and stoppable):
                break
        return fault
