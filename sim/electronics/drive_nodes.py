"""Emulate three CiA 402 drives as CANopen nodes: states, homing, cyclic synchronous position."""

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
from ...wire.velocity_from_positions import ROUNDED_COUNTS, Differences, most_bend
from .emulated_devices import Core
from .faults import Injector, Outgoing

Send = Callable[[int, bytes], None]
Frame = tuple[int, bytes]

_HOMING_S = 0.02
_POLL_S = 0.005
_COUNTS_16, _COUNTS_32 = 32767, 1 << 31
_RATED_BEAM, _RATED_ROTOR = 1000, 10
"""Rated force of X1 and X2 in mN and torque of PHI in mN m: the ranges are 32 N and 0.3 N m."""
_X1_AT, _X2_AT, _PHI_AT_RAD = 0.3, -0.2, 0.7
"""Origin of the counts before homing, of X1 and X2 in shares of the beam's range: an incremental
encoder counts from its position at power-on."""
_TIMES_SPEED = 1.1
"""Share of the speed limit above which a target is a following error."""


class DriveNodes:
    """X1, X2 and PHI on one bus: `handle_frame` passes frames to them, `poll` sends heartbeats."""

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
        self._was_operating = self._had_targets = False
        self._plan_cycle = 0
        self._poll_at_s = 0.0

    @property
    def counts_syncs(self) -> bool:
        """Whether SYNC has a counter."""
        return all(drive.counts_syncs for drive in self.drives)

    def boot(self) -> None:
        """Send the boot-up messages."""
        for drive in self.drives:
            drive.boot()

    def handle_frame(self, can_id: int, data: bytes) -> None:
        """Handle a frame that is not SYNC."""
        drive = self._rpdo.get(can_id)
        if drive is not None:
            accepted = drive.cyclic and "drop-setpoints" not in self._injector.wire
            if accepted and len(data) == RPDO.size:
                drive.store_rpdo(*RPDO.unpack(data))
        else:
            self.poll()
            with contextlib.suppress(Exception):  # canopen raises on frames that are too short
                self._network.notify(can_id, bytearray(data), 0.0)
            for drive in self.drives:
                drive.drop_unless_cyclic()
            self._update_plant()

    def sync(self) -> list[Frame]:
        """Apply the received RPDOs and return the TPDOs of the new cycle."""
        core = self._core
        for drive in self.drives:
            drive.apply_rpdo()
        self._update_plant()
        self._plan_if_complete()
        with core.lock:
            axes = core.axes.copy()
            lost = set(core.injected.lost_axes)
        for drive, (position, _, force) in zip(self.drives, axes, strict=True):
            drive.update_readings(position, force)
            if drive.axis in lost:
                drive.fail(ENCODER_LOST, 0x21)
            drive.has_setpoint = False
        self._expire()
        self._update_plant()
        batch = [drive.tpdo() for drive in self.drives if drive.cyclic]
        return self._outgoing.through(batch) if batch else []

    def poll(self) -> None:
        """Send the heartbeats that are due; may be called at any time."""
        now_s = time.monotonic()
        if now_s < self._poll_at_s:
            return
        self._poll_at_s = now_s + _POLL_S
        with self._core.lock:
            axes = self._core.axes.copy()
        for drive, (position, _, force) in zip(self.drives, axes, strict=True):
            drive.update_readings(position, force)
            drive.heartbeat(now_s)
        self._expire()
        self._update_plant()

    def _expire(self) -> None:
        """Set drives in fault whose targets have stopped, by their event timer."""
        drives_silent_s = self._core.drives_silent_s
        self._had_targets = self._was_operating and (self._had_targets or not drives_silent_s)
        if not (self._had_targets and drives_silent_s):
            return
        for drive in self.drives:
            if 0.0 < drive.event_timer_s <= drives_silent_s:
                drive.fail(RPDO_TIMEOUT, 0x11)

    def _update_plant(self) -> None:
        """Enable or disable the drives of the plant by the state of all three."""
        operating = all(drive.operating for drive in self.drives)
        if operating and not self._was_operating:
            with self._core.lock:
                self._core.enable_drives()
                beam, rotor = self._core.motion[:, 0]
            self._differences[0].at_rest(float(beam))
            self._differences[1].at_rest(float(rotor))
            self._plan_cycle = self._core.cycle
            for drive, at in zip(self.drives, (beam, beam, rotor), strict=True):
                drive.start_following(float(at))
        elif not operating and self._was_operating:
            self._core.disable_drives(max(drive.error for drive in self.drives))
        self._was_operating = operating

    def _plan_if_complete(self) -> None:
        """Plan the motion from the current setpoint to the new targets, over `every` periods."""
        if not (self._was_operating and all(drive.has_setpoint for drive in self.drives)):
            return
        begin, cycle = self._core.motion, self._core.cycle
        cycles = (cycle - self._plan_cycle) % CYCLES
        regular = cycles == self.every
        self._plan_cycle = cycle
        n, T = self.every, self._core.period_s * self.every
        # Without a counter, the cycle is known from another bus, before or after this SYNC. After
        # skipped cycles, a SYNC may be late by all but one of its `every` cycles.
        known, late_s = regular and self.counts_syncs, (n - 1) * self._core.period_s
        lost = [d for d in self.drives if not d.can_reach(max(cycles / n, 1.0), T, late_s, known)]
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
    """One node: object dictionary, CiA 402 states, arbitrary origin of counts until homed.

    `node` has the objects; a homing takes `homing_s`.
    """

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
        self.node: Any = canopen.LocalNode(node_id, eds)
        network.add_node(self.node)
        # Nothing is mapped: the host has to map the PDOs.
        unmapped = {(Object.RPDO1_MAP, 0): 0, (Object.TPDO1_MAP, 0): 0}
        for (index, sub), value in ({(Object.RATED_FORCE, 0): rated} | unmapped | limits).items():
            entry = self.node.object_dictionary[int(index)]
            variable = (
                entry if isinstance(entry, canopen.objectdictionary.ODVariable) else entry[sub]
            )
            self.node.set_data(int(index), sub, variable.encode_raw(value))
        self.counts_syncs = self._syncs_are_counted()
        """Whether SYNC has a counter, read at power-on."""
        self.node.add_read_callback(self._read)  # type: ignore[no-untyped-call]
        self.node.add_write_callback(self._written)  # type: ignore[no-untyped-call]
        self.state = DriveStates.SWITCH_ON_DISABLED
        self.mode = 0
        self.homing_s = _HOMING_S
        self.error = 0
        self.has_setpoint = False
        self._mapped: bool | None = None
        self._stored: tuple[int, int] | None = None
        self._homed = False
        self._homed_at_s = 0.0
        self._position = self._force = 0.0
        self._origin = self._unhomed = origin
        self._target = 0
        self._speed = limits[Object.MAX_SPEED, 0] * unit
        self._acceleration = limits[Object.MAX_ACCELERATION, 0] * ACCELERATION
        self._last_target, self._last_step, self._skipped = 0.0, math.nan, 0.0
        self._controlword = 0
        self._heartbeat_s = 0.0

    @property
    def cyclic(self) -> bool:
        """Whether PDOs are exchanged: the node is operational, the PDOs are mapped and valid."""
        if self._mapped is None:  # a mapping object was written
            self._mapped = self._has_mapping()
        return bool(self.node.nmt._state == Node.OPERATIONAL) and self._mapped

    @property
    def operating(self) -> bool:
        """Whether the drive can_reach its targets."""
        return self.state is DriveStates.OPERATION_ENABLED and (
            self.mode == Mode.CYCLIC_SYNCHRONOUS_POSITION
        )

    @property
    def target(self) -> float:
        """Target position in m or rad, in the coordinates of the plant."""
        return self._target * self._unit + self._origin

    def start_following(self, at: float) -> None:
        """Start to follow targets at position `at` of the plant."""
        self._last_target, self._last_step, self._skipped = at, math.nan, 0.0

    def can_reach(self, syncs: float, sync_s: float, late_s: float, regular: bool) -> bool:
        """Return whether the drive's limits allow the target, `syncs` SYNCs after the last one.

        The previous target may be lost, or late by `late_s`; after skipped cycles the target
        catches up. The change of speed is known only for consecutive SYNCs (`regular`).
        """
        by = self.target - self._last_target
        skipped, self._skipped = self._skipped, syncs - 1.0
        regular = regular and not skipped
        changed = by - self._last_step if regular else math.nan
        self._last_target, self._last_step = self.target, by if regular else math.nan
        reach = _TIMES_SPEED * self._speed * (skipped + syncs + 1.0) * sync_s
        most = most_bend(self._acceleration, sync_s, self._unit) + 2.0 * self._speed * late_s
        return not (abs(by) > reach + ROUNDED_COUNTS * self._unit or abs(changed) > most)

    def boot(self) -> None:
        """Send the boot-up message and enter pre-operational."""
        self.node.nmt.send_command(Node.BOOT_UP.value)
        self.node.nmt.send_command(Node.PRE_OPERATIONAL.value)

    def update_readings(self, position: float, force: float) -> None:
        """Update position and force, in SI units; complete a homing whose time has passed."""
        self._position, self._force = position, force
        if self._homed_at_s and time.monotonic() >= self._homed_at_s:
            self._homed, self._homed_at_s, self._origin = True, 0.0, 0.0

    @property
    def has_rpdo(self) -> bool:
        """Whether an RPDO is stored for the next SYNC."""
        return self._stored is not None

    def store_rpdo(self, controlword: int, target: int) -> None:
        """Store a received RPDO until the next SYNC; a later one replaces it."""
        self._stored = controlword, target

    def drop_unless_cyclic(self) -> None:
        """Discard the stored RPDO if PDOs are no longer exchanged."""
        if self.has_rpdo and not self.cyclic:
            self._stored = None

    def apply_rpdo(self) -> None:
        """Apply the stored RPDO."""
        if self._stored is not None:
            controlword, self._target = self._stored
            self._stored, self.has_setpoint = None, True
            self._control(controlword)

    def tpdo(self) -> Frame:
        """Return the TPDO with state, position and force."""
        per_mille = min(max(round(self._force / self._per_mille), -_COUNTS_16), _COUNTS_16)
        return TPDO1_ID + self.node_id, TPDO.pack(self.statusword, self._counts, per_mille)

    def _has_mapping(self) -> bool:
        """Return whether both PDOs are valid, synchronous and mapped as this drive expects."""
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
        return int(self.node.sdo[int(index)][sub].raw)

    def _syncs_are_counted(self) -> bool:
        index = int(Object.SYNC_OVERFLOW)
        known = index in self.node.object_dictionary
        return known and int(self.node.sdo[index].raw) == SYNC_COUNTER

    def fail(self, error: int, register: int) -> None:
        """Enter the fault state and send an emergency."""
        if self.state is not DriveStates.FAULT:
            self.state, self.error, self._homed_at_s = DriveStates.FAULT, error, 0.0
            self.node.emcy.send(error, register)

    @property
    def event_timer_s(self) -> float:
        """Longest time without targets in s; 0: no limit."""
        return 1e-3 * int(self.node.sdo[int(Object.RPDO1)][EVENT_TIMER].raw)

    def heartbeat(self, now_s: float) -> None:
        """Send a heartbeat if it is due."""
        period_s = 1e-3 * int(self.node.sdo[int(Object.HEARTBEAT_MS)].raw)
        if period_s and now_s - self._heartbeat_s >= period_s:
            self._heartbeat_s = now_s
            state = bytes((self.node.nmt._state,))
            self.node.network.send_message(HEARTBEAT_ID + self.node_id, state)

    @property
    def statusword(self) -> int:
        """Statusword: state, and in homing mode the result."""
        word = self.state.value[1] | (1 << 9)
        if self.mode == Mode.HOMING and not self._homed_at_s:  # at rest
            word |= TARGET_REACHED | (HOMING_ATTAINED if self._homed else 0)
        return word

    @property
    def _counts(self) -> int:
        counts = round((self._position - self._origin) / self._unit)
        return (counts + _COUNTS_32) % (
            2 * _COUNTS_32
        ) - _COUNTS_32  # wraps like an encoder counter

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
                if self.error == ENCODER_LOST:  # and so is the origin
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
            self._homed, self._homed_at_s = False, time.monotonic() + self.homing_s


_OBJECTS = frozenset(Object)
_SYNCHRONOUS = 1
_PDOS = (
    (Object.RPDO1, Object.RPDO1_MAP, RPDO1_ID, RPDO_MAPPING),
    (Object.TPDO1, Object.TPDO1_MAP, TPDO1_ID, TPDO_MAPPING),
)
_MAPPED_BY = frozenset(index for record, mapping, _, _ in _PDOS for index in (record, mapping))


class _Network(canopen.Network):
    """Network of canopen on the bus of the electronics."""

    def __init__(self, send: Send) -> None:
        super().__init__()
        self._send_frame = send

    def send_message(self, can_id: int, data: Any, remote: bool = False) -> None:  # noqa: ARG002
        self._send_frame(can_id, bytes(data))

    def send_periodic(self, *_: Any, **__: Any) -> Any:
        return _NoTask()


class _NoTask:
    """Disables the heartbeats of canopen; Drive sends its own."""

    def stop(self) -> None:
        return

    def update(self, data: Any) -> None:  # noqa: ARG002
        return


def quintic(begin: np.ndarray, end: np.ndarray, s: float, T: float) -> np.ndarray:
    """Return position, velocity, acceleration (n, 3) at time s T of a quintic between states."""
    p0, v0, a0 = begin[:, 0], begin[:, 1] * T, begin[:, 2] * T * T
    d, v1, a1 = end[:, 0] - p0, end[:, 1] * T, end[:, 2] * T * T
    c3 = 10.0 * d - 6.0 * v0 - 4.0 * v1 - 1.5 * a0 + 0.5 * a1
    c4 = -15.0 * d + 8.0 * v0 + 7.0 * v1 + 1.5 * a0 - a1
    c5 = 6.0 * d - 3.0 * (v0 + v1) - 0.5 * (a0 - a1)
    p = p0 + s * (v0 + s * (0.5 * a0 + s * (c3 + s * (c4 + s * c5))))
    v = v0 + s * (a0 + s * (3.0 * c3 + s * (4.0 * c4 + s * 5.0 * c5)))
    a = a0 + s * (6.0 * c3 + s * (12.0 * c4 + s * 20.0 * c5))
    return np.stack([p, v / T, a / (T * T)], axis=1)
