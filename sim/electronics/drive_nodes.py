"""Three CiA 402 drives as CANopen nodes: states, homing, cyclic synchronous position."""

from __future__ import annotations

import contextlib
import logging
import math
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import canopen
import numpy as np

from ...config.buses import CanDriveOptions
from ...config.rig import RigConfig
from ...config.shipped import shipped
from ...wire.can.cia402 import (
    ACCELERATION,
    ENCODER_LOST,
    EVENT_TIMER,
    FOLLOWING_ERROR,
    HEARTBEAT_ID,
    HOMING_ATTAINED,
    POSITION_M,
    POSITION_RAD,
    RATED,
    RPDO,
    RPDO1_ID,
    RPDO_MAPPING,
    RPDO_TIMEOUT,
    SYNC_COUNTER,
    TARGET_REACHED,
    TPDO,
    TPDO1_ID,
    TPDO_MAPPING,
    DriveStates,
    Mode,
    Node,
    Object,
    beam_limits,
    rotor_limits,
)
from ...wire.device_protocol import CYCLES
from ...wire.finite_differences import ROUNDED_COUNTS, Differences, most_bend
from .core import Core
from .faults import Injector, Outgoing

Send = Callable[[int, bytes], None]
Frame = tuple[int, bytes]

_HOMING_S = 0.02
_POLL_S = 0.005
_COUNTS_16, _COUNTS_32 = 32767, 1 << 31
_RATED_BEAM, _RATED_ROTOR = 1000, 10
"""Rated force of X1 and X2 in mN and torque of PHI in mN m, so that an actual one has a range of
32 N and 0.3 N m."""
_X1_AT, _X2_AT, _PHI_AT_RAD = 0.3, -0.2, 0.7
"""Where counts are zero until a drive is homed, of X1 and X2 in shares of the beam's range: an
encoder of increments counts from wherever it was switched on."""
_TIMES_SPEED = 1.1
"""How much more than the limit of speed is no following error."""


class DriveNodes:
    """X1, X2 and PHI on one bus; `take` hands them frames, `poll` lets them send heartbeats."""

    def __init__(
        self,
        rig: RigConfig,
        options: CanDriveOptions,
        eds: Path | None,
        core: Core,
        injector: Injector,
        send: Send,
    ) -> None:
        logging.getLogger("canopen").setLevel(logging.ERROR)
        self._core, self._injector, self._send = core, injector, send
        self._network = _Network(send)
        path = str(eds or shipped("drive.eds"))
        beam, rotor = beam_limits(rig.limits), rotor_limits(rig.limits)
        numbers = (options.nodes.x1, options.nodes.x2, options.nodes.phi)
        units = ((POSITION_M, _RATED_BEAM),) * 2 + ((POSITION_RAD, _RATED_ROTOR),)
        range_m = rig.limits.beam_m
        origins = (_X1_AT * range_m, _X2_AT * range_m, _PHI_AT_RAD)
        self.drives = [
            Drive(i, number, path, self._network, limits, *unit, origin)
            for i, (number, limits, unit, origin) in enumerate(
                zip(numbers, (beam, beam, rotor), units, origins, strict=True)
            )
        ]
        self.every = options.every
        self._rpdo = {RPDO1_ID + drive.node_id: drive for drive in self.drives}
        self._differences = [Differences(core.period_s * self.every) for _ in range(2)]
        self._outgoing = Outgoing(injector)
        self._was_operating = self._was_told = False
        self._planned_at = 0
        self._poll_at_s = 0.0

    @property
    def counts_syncs(self) -> bool:
        """Whether a SYNC has a counter."""
        return all(drive.counts_syncs for drive in self.drives)

    def boot(self) -> None:
        """Announce all nodes."""
        for drive in self.drives:
            drive.boot()

    def take(self, can_id: int, data: bytes) -> None:
        """Take a frame that is not SYNC."""
        drive = self._rpdo.get(can_id)
        if drive is not None:
            heard = drive.cyclic and "drop-setpoints" not in self._injector.wire
            if heard and len(data) == RPDO.size:
                drive.keep(*RPDO.unpack(data))
        else:
            self.poll()
            with contextlib.suppress(Exception):  # the library raises on frames that are too short
                self._network.notify(can_id, bytearray(data), 0.0)
            for drive in self.drives:
                drive.forget_unless_cyclic()
            self._follow()

    def sync(self) -> list[Frame]:
        """Take over the RPDOs that came, and return the TPDOs, of the cycle that has just begun."""
        core = self._core
        for drive in self.drives:
            drive.take_over()
        self._follow()
        self._plan_if_complete()
        with core.lock:
            axes = core.axes.copy()
            lost = set(core.injected.lost_axes)
        for drive, (position, _, force) in zip(self.drives, axes, strict=True):
            drive.see(position, force)
            if drive.axis in lost:
                drive.fail(ENCODER_LOST, 0x21)
            drive.has_setpoint = False
        self._expire()
        self._follow()
        batch = [drive.tpdo() for drive in self.drives if drive.cyclic]
        return self._outgoing.through(batch) if batch else []

    def poll(self) -> None:
        """Send the heartbeats that are due; may be called at any time, and mostly does nothing."""
        now_s = time.monotonic()
        if now_s < self._poll_at_s:
            return
        self._poll_at_s = now_s + _POLL_S
        with self._core.lock:
            axes = self._core.axes.copy()
        for drive, (position, _, force) in zip(self.drives, axes, strict=True):
            drive.see(position, force)
            drive.heartbeat(now_s)
        self._expire()
        self._follow()

    def _expire(self) -> None:
        """Let drives fail whose targets have stopped coming, once some came."""
        untold_s = self._core.untold_s
        self._was_told = self._was_operating and (self._was_told or not untold_s)
        if not (self._was_told and untold_s):
            return
        for drive in self.drives:
            if 0.0 < drive.event_timer_s <= untold_s:
                drive.fail(RPDO_TIMEOUT, 0x11)

    def _follow(self) -> None:
        """Let the plant's drives follow the state of all three together."""
        operating = all(drive.operating for drive in self.drives)
        if operating and not self._was_operating:
            with self._core.lock:
                self._core.enable_drives()
                beam, rotor = self._core.motion[:, 0]
            self._differences[0].at_rest(float(beam))
            self._differences[1].at_rest(float(rotor))
            self._planned_at = self._core.cycle
            for drive, at in zip(self.drives, (beam, beam, rotor), strict=True):
                drive.stand(float(at))
        elif not operating and self._was_operating:
            self._core.disable_drives(max(drive.error for drive in self.drives))
        self._was_operating = operating

    def _plan_if_complete(self) -> None:
        """Lead from where the drives are told to be to the new targets, in `every` periods."""
        if not (self._was_operating and all(drive.has_setpoint for drive in self.drives)):
            return
        begin, cycle = self._core.motion, self._core.cycle
        cycles = (cycle - self._planned_at) % CYCLES
        regular = cycles == self.every
        self._planned_at = cycle
        n, T = self.every, self._core.period_s * self.every
        # Without a counter another bus tells the cycle, sooner or later than this one's SYNC. With
        # fewer SYNCs than cycles one may be late by all but one of these, where some were skipped.
        known, late_s = regular and self.counts_syncs, (n - 1) * self._core.period_s
        lost = [d for d in self.drives if not d.follows(max(cycles / n, 1.0), T, late_s, known)]
        for drive in lost:
            drive.fail(FOLLOWING_ERROR, 0x21)
        if lost:
            return
        x1, x2, phi = (drive.target for drive in self.drives)
        targets = 0.5 * (x1 + x2), phi
        end = np.array(
            [
                (p, *(moved.push(p) if regular else moved.resume(p)))
                for p, moved in zip(targets, self._differences, strict=True)
            ]
        )
        plan = [quintic(begin, end, i / n, T) for i in range(1, n)]
        self._core.drive_setpoints([*plan, end], begun=True)
        for drive in self.drives:
            drive.has_setpoint = False


class Drive:
    """One node: object dictionary, states of CiA 402, counts from anywhere until it is homed."""

    def __init__(
        self,
        axis: int,
        node_id: int,
        eds: str,
        network: canopen.Network,
        limits: dict[tuple[Object, int], int],
        unit: float,
        rated: int,
        origin: float,
    ) -> None:
        self.axis, self.node_id = axis, node_id
        self._unit, self._per_mille = unit, 1e-3 * RATED * rated
        self._node: Any = canopen.LocalNode(node_id, eds)
        network.add_node(self._node)
        # Nothing is mapped yet: a drive may come with any mapping, and it is the host's to set.
        unmapped = {(Object.RPDO1_MAP, 0): 0, (Object.TPDO1_MAP, 0): 0}
        for (index, sub), value in ({(Object.RATED_FORCE, 0): rated} | unmapped | limits).items():
            entry = self._node.object_dictionary[int(index)]
            variable = (
                entry if isinstance(entry, canopen.objectdictionary.ODVariable) else entry[sub]
            )
            self._node.set_data(int(index), sub, variable.encode_raw(value))
        self.counts_syncs = self._syncs_are_counted()
        """Whether its SYNC has a counter: what it is switched on with."""
        self._node.add_read_callback(self._read)  # type: ignore[no-untyped-call]
        self._node.add_write_callback(self._written)  # type: ignore[no-untyped-call]
        self.state = DriveStates.SWITCH_ON_DISABLED
        self.mode = 0
        self.error = 0
        self.has_setpoint = False
        self._mapped: bool | None = None
        self._kept: tuple[int, int] | None = None
        self._homed = False
        self._homed_at_s = 0.0
        self._true = self._force = 0.0
        self._origin = self._unhomed = origin
        self._target = 0
        self._speed = limits[Object.MAX_SPEED, 0] * unit
        self._acceleration = limits[Object.MAX_ACCELERATION, 0] * ACCELERATION
        self._led_to, self._led_by, self._skipped = 0.0, math.nan, 0.0
        self._controlword = 0
        self._heartbeat_s = 0.0

    @property
    def cyclic(self) -> bool:
        """Whether PDOs are exchanged: in the state for it, once they are mapped and valid."""
        if self._mapped is None:  # since an object of theirs was written
            self._mapped = self._has_mapping()
        return bool(self._node.nmt._state == Node.OPERATIONAL) and self._mapped

    @property
    def operating(self) -> bool:
        """Whether the drive follows its targets."""
        return self.state is DriveStates.OPERATION_ENABLED and (
            self.mode == Mode.CYCLIC_SYNCHRONOUS_POSITION
        )

    @property
    def target(self) -> float:
        """Target position in SI units, from the plant's zero."""
        return self._target * self._unit + self._origin

    def stand(self, at: float) -> None:
        """Begin to follow targets, from where the plant is held: encoders may have run away."""
        self._led_to, self._led_by, self._skipped = at, math.nan, 0.0

    def follows(self, syncs: float, sync_s: float, late_s: float, regular: bool) -> bool:
        """Return whether its limits allow for the target, so many SYNCs after the last one.

        One may have been lost before, or be late by `late_s`; and where cycles were skipped the
        target after that makes up for them. How the speed changed is known of SYNCs alone that came
        in a row (`regular`).
        """
        by = self.target - self._led_to
        skipped, self._skipped = self._skipped, syncs - 1.0
        regular = regular and not skipped
        changed = by - self._led_by if regular else math.nan
        self._led_to, self._led_by = self.target, by if regular else math.nan
        reach = _TIMES_SPEED * self._speed * (skipped + syncs + 1.0) * sync_s
        most = most_bend(self._acceleration, sync_s, self._unit) + 2.0 * self._speed * late_s
        return not (abs(by) > reach + ROUNDED_COUNTS * self._unit or abs(changed) > most)

    def boot(self) -> None:
        """Announce itself."""
        self._node.nmt.send_command(Node.BOOT_UP.value)
        self._node.nmt.send_command(Node.PRE_OPERATIONAL.value)

    def see(self, position: float, force: float) -> None:
        """Look at encoder and force, in SI units; end a homing that took its time."""
        self._true, self._force = position, force
        if self._homed_at_s and time.monotonic() >= self._homed_at_s:
            self._homed, self._homed_at_s, self._origin = True, 0.0, 0.0

    def keep(self, controlword: int, target: int) -> None:
        """Keep an RPDO, which is synchronous: of several the last one."""
        self._kept = controlword, target

    def forget_unless_cyclic(self) -> None:
        """Drop an RPDO that no SYNC took over while PDOs were exchanged."""
        if self._kept is not None and not self.cyclic:
            self._kept = None

    def take_over(self) -> None:
        """Take over the RPDO that came since the last SYNC, if one did."""
        if self._kept is not None:
            controlword, self._target = self._kept
            self._kept, self.has_setpoint = None, True
            self._control(controlword)

    def tpdo(self) -> Frame:
        """Return the TPDO with what the drive is doing now."""
        per_mille = min(max(round(self._force / self._per_mille), -_COUNTS_16), _COUNTS_16)
        return TPDO1_ID + self.node_id, TPDO.pack(self.statusword, self._counts, per_mille)

    def _has_mapping(self) -> bool:
        """Return whether both PDOs are valid, synchronous, and hold what this drive exchanges."""
        return all(
            self._value(record, 1) == base + self.node_id
            and self._value(record, 2) == _SYNCHRONOUS
            and self._value(mapping, 0) == len(objects)
            and all(
                self._value(mapping, i) == index << 16 | bits
                for i, (index, bits) in enumerate(objects, start=1)
            )
            for record, mapping, base, objects in _PDOS
        )

    def _value(self, index: Object, sub: int) -> int:
        return int(self._node.sdo[int(index)][sub].raw)

    def _syncs_are_counted(self) -> bool:
        index = int(Object.SYNC_OVERFLOW)
        known = index in self._node.object_dictionary
        return known and int(self._node.sdo[index].raw) == SYNC_COUNTER

    def fail(self, error: int, register: int) -> None:
        """Go into fault and say so by an emergency message."""
        if self.state is not DriveStates.FAULT:
            self.state, self.error, self._homed_at_s = DriveStates.FAULT, error, 0.0
            self._node.emcy.send(error, register)

    @property
    def event_timer_s(self) -> float:
        """How long targets may stay away; 0 is for ever."""
        return 1e-3 * int(self._node.sdo[int(Object.RPDO1)][EVENT_TIMER].raw)

    def heartbeat(self, now_s: float) -> None:
        """Send a heartbeat where one is due."""
        period_s = 1e-3 * int(self._node.sdo[int(Object.HEARTBEAT_MS)].raw)
        if period_s and now_s - self._heartbeat_s >= period_s:
            self._heartbeat_s = now_s
            state = bytes((self._node.nmt._state,))
            self._node.network.send_message(HEARTBEAT_ID + self.node_id, state)

    @property
    def statusword(self) -> int:
        """The statusword: state, and in homing mode whether it is done."""
        word = self.state.value[1] | (1 << 9)
        if self.mode == Mode.HOMING and not self._homed_at_s:  # it stands
            word |= TARGET_REACHED | (HOMING_ATTAINED if self._homed else 0)
        return word

    @property
    def _counts(self) -> int:
        counts = round((self._true - self._origin) / self._unit)
        return (counts + _COUNTS_32) % (2 * _COUNTS_32) - _COUNTS_32  # as an encoder's counter does

    def _read(self, *, index: int, subindex: int, od: object) -> int | None:  # noqa: ARG002
        found = {
            Object.STATUSWORD: self.statusword,
            Object.ACTUAL_POSITION: self._counts,
            Object.MODE_DISPLAY: self.mode,
            Object.ERROR_CODE: self.error,
        }
        return found.get(Object(index)) if index in _OBJECTS else None

    def _written(self, *, index: int, subindex: int, od: Any, data: bytes) -> None:  # noqa: ARG002
        if index in _MAPPED_BY:
            self._mapped = None
        elif index == Object.CONTROLWORD:
            self._control(od.decode_raw(data))
        elif index == Object.MODE:
            self.mode = od.decode_raw(data)
        elif index == Object.TARGET_POSITION:
            self._target = od.decode_raw(data)

    def _control(self, word: int) -> None:
        last, self._controlword = self._controlword, word
        if self.state is DriveStates.FAULT:
            if word & 0x80 and not last & 0x80:
                if self.error == ENCODER_LOST:  # so is where it was
                    self._homed, self._origin = False, self._unhomed
                self.state, self.error = DriveStates.SWITCH_ON_DISABLED, 0
            return
        if not word & 0x02:
            self.state = DriveStates.SWITCH_ON_DISABLED
        elif word & 0x07 == 0x06 and self.state is not DriveStates.QUICK_STOP_ACTIVE:
            self.state = DriveStates.READY_TO_SWITCH_ON
        elif word & 0x0F == 0x07 and self.state is not DriveStates.SWITCH_ON_DISABLED:
            self.state = DriveStates.SWITCHED_ON
        elif word & 0x0F == 0x0F and self.state is not DriveStates.SWITCH_ON_DISABLED:
            self.state = DriveStates.OPERATION_ENABLED
        elif not word & 0x04:
            enabled = self.state is DriveStates.OPERATION_ENABLED
            self.state = (
                DriveStates.QUICK_STOP_ACTIVE if enabled else DriveStates.SWITCH_ON_DISABLED
            )
        if self.state is not DriveStates.OPERATION_ENABLED or not word & 0x10:
            self._homed_at_s = 0.0
        starts = word & 0x10 and not last & 0x10
        if self.mode == Mode.HOMING and starts and self.state is DriveStates.OPERATION_ENABLED:
            self._homed, self._homed_at_s = False, time.monotonic() + _HOMING_S


_OBJECTS = frozenset(Object)
_SYNCHRONOUS = 1
_PDOS = (
    (Object.RPDO1, Object.RPDO1_MAP, RPDO1_ID, RPDO_MAPPING),
    (Object.TPDO1, Object.TPDO1_MAP, TPDO1_ID, TPDO_MAPPING),
)
_MAPPED_BY = frozenset(index for record, mapping, _, _ in _PDOS for index in (record, mapping))


class _Network(canopen.Network):
    """The library's nodes on the bus of the electronics."""

    def __init__(self, send: Send) -> None:
        super().__init__()
        self._send_frame = send

    def send_message(self, can_id: int, data: Any, remote: bool = False) -> None:  # noqa: ARG002
        self._send_frame(can_id, bytes(data))

    def send_periodic(self, *_: Any, **__: Any) -> Any:
        return _NoTask()


class _NoTask:
    """The library's heartbeats; those of Drive are sent instead."""

    def stop(self) -> None:
        return

    def update(self, data: Any) -> None:  # noqa: ARG002
        return


def quintic(begin: np.ndarray, end: np.ndarray, s: float, T: float) -> np.ndarray:
    """Return position, velocity, acceleration (n, 3) at share s of T between two such states."""
    p0, v0, a0 = begin[:, 0], begin[:, 1] * T, begin[:, 2] * T * T
    d, v1, a1 = end[:, 0] - p0, end[:, 1] * T, end[:, 2] * T * T
    c3 = 10.0 * d - 6.0 * v0 - 4.0 * v1 - 1.5 * a0 + 0.5 * a1
    c4 = -15.0 * d + 8.0 * v0 + 7.0 * v1 + 1.5 * a0 - a1
    c5 = 6.0 * d - 3.0 * (v0 + v1) - 0.5 * (a0 - a1)
    p = p0 + s * (v0 + s * (0.5 * a0 + s * (c3 + s * (c4 + s * c5))))
    v = v0 + s * (a0 + s * (3.0 * c3 + s * (4.0 * c4 + s * 5.0 * c5)))
    a = a0 + s * (6.0 * c3 + s * (12.0 * c4 + s * 20.0 * c5))
    return np.stack([p, v / T, a / (T * T)], axis=1)
