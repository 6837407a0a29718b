"""Gantry and rotor on CANopen drives: targets out and positions in by PDO, watched every cycle."""

from __future__ import annotations

import struct
from collections.abc import Callable
from pathlib import Path
from time import perf_counter

from ...config.buses import CanDriveOptions
from ...config.rig import RigConfig
from ...wire.cia402 import (
    EMERGENCY_ID,
    ENABLE_OPERATION,
    FORCE_N,
    HEARTBEAT_ID,
    POSITION_M,
    POSITION_RAD,
    QUICK_STOP,
    RPDO,
    RPDO1_ID,
    SYNC_ID,
    TORQUE_N_M,
    TPDO,
    TPDO1_ID,
    DriveStates,
    beam_limits,
    rotor_limits,
    state_of,
    sync_counter,
)
from ...wire.differences import Differences
from ...wire.rejected import Rejected
from ..base import Array, DriveError, ManipulatorDrives
from ..sensing import check_skew
from ..watch import Watch
from .link import CanLink
from .nodes import DriveNode

_EMERGENCY = struct.Struct("<HB")
_MISSED_HEARTBEATS = 3.0
_MOST = 2**31 - 1


class CanDrives(ManipulatorDrives):
    """Three CiA 402 nodes in cyclic synchronous position mode: X1, X2, PHI."""

    def __init__(
        self,
        link: CanLink,
        rig: RigConfig,
        options: CanDriveOptions,
        folder: Path,
        stale_cycles: int,
        deadline: Callable[[], float],
    ) -> None:
        self.what = f"drives on {link.what}"
        self.watch = Watch(self.what, stale_cycles)
        self._link, self._options, self._deadline = link, options, deadline
        self._limits, self._period_s = rig.limits, 1.0 / rig.rate_hz
        self._sync_s = self._period_s * options.every
        self._cycle, self._sync_cycle, self._answer_due = 0, -options.every, 0
        eds = folder / options.eds if options.eds else None
        numbers = options.nodes.model_dump()
        self._nodes = [DriveNode(name, number, eds, link) for name, number in numbers.items()]
        units = (POSITION_M, POSITION_M, POSITION_RAD)
        self._axes = [
            _Axis(node, unit, options.every, self._sync_s)
            for node, unit in zip(self._nodes, units, strict=True)
        ]
        self._counted = all(node.counts_syncs for node in self._nodes)
        self._by_id = {TPDO1_ID + axis.node.node_id: axis for axis in self._axes}
        for axis in self._axes:
            node_id = axis.node.node_id
            link.listen(TPDO1_ID + node_id, self._take)
            link.listen(EMERGENCY_ID + node_id, axis.emergency)
            link.listen(HEARTBEAT_ID + node_id, axis.heartbeat)
        self._waiting = 0
        self._judged = True
        self._told = False

    def sync(self, cycle: int) -> None:
        """Send SYNC in the cycles that have one; what comes from here on belongs to it."""
        self._cycle = cycle
        if cycle - self._sync_cycle < self._options.every:
            return
        self._judge()
        self.watch.begin()
        self._waiting = len(self._axes)
        for axis in self._axes:
            axis.came = False
        # Slower drives have until the next SYNC to answer.
        self._answer_due = cycle if self._options.every == 1 else self._sync_cycle
        self._judged, self._sync_cycle = False, cycle
        self._send_sync(cycle)

    def write(self, beam: Array, rotor: Array) -> None:
        """Send targets, which the drives reach one SYNC after the next."""
        # The setpoint is of the end of the coming period; with fewer SYNCs than cycles the drive
        # gets there later, and the target lies as much further on.
        if self._cycle + 1 - self._sync_cycle < self._options.every:
            return
        ahead_s = self._sync_s - self._period_s
        x_m = beam[0] + ahead_s * (beam[1] + 0.5 * ahead_s * beam[2])
        phi_rad = rotor[0] + ahead_s * (rotor[1] + 0.5 * ahead_s * rotor[2])
        for axis, target in zip(self._axes, (x_m, x_m, phi_rad), strict=True):
            counts = min(max(round(float(target) / axis.unit), -_MOST), _MOST)
            self._link.send(RPDO1_ID + axis.node.node_id, RPDO.pack(ENABLE_OPERATION, counts))

    def read(self, beam: Array, rotor: Array) -> None:
        """Fill beam (3,) with m, m/s, N and rotor (3,) with rad, rad/s, N m of the last SYNC.

        Raises:
            StaleError: positions did not come in too many cycles in a row.
            DriveError: a drive is in fault, silent, or the gantry is askew; once, until recovered.
        """
        if self._options.every == 1:
            deadline_s = self._deadline()
            while self._waiting and self._link.receive(deadline_s):
                pass
            self._judge()
        x1, x2, phi = self._axes
        self.stale = self.STALE if x1.cycle < self._answer_due else 0
        # Slower drives are not waited for: between their readings position goes on at its speed.
        since_s = (self._cycle - x1.cycle) * self._period_s
        beam[0] = 0.5 * (x1.position + x2.position + since_s * (x1.velocity + x2.velocity))
        beam[1] = 0.5 * (x1.velocity + x2.velocity)
        beam[2] = (x1.force + x2.force) * FORCE_N
        rotor[0] = phi.position + since_s * phi.velocity
        rotor[1] = phi.velocity
        rotor[2] = phi.force * TORQUE_N_M
        if not self._told:
            self._told = True
            self._check()
            self._told = False

    def recover(self) -> None:
        """Compare limits, map PDOs, home and enable every drive; raises DriverError."""
        options = self._options
        heartbeat_ms, expire_ms = (round(1e3 * s) for s in (options.heartbeat_s, options.expire_s))
        beam, rotor = beam_limits(self._limits), rotor_limits(self._limits)
        for axis, limits in zip(self._axes, (beam, beam, rotor), strict=True):
            axis.node.configure(limits, heartbeat_ms, expire_ms, self._sync_s)
        for axis in self._axes:
            axis.node.enable(options.homing_method)
            axis.begin(axis.node.position())
        self.watch.reset()
        self._judged, self._told = True, False

    def release(self) -> None:
        """Let the drives brake and switch off: who goes on purpose is not to be missed."""
        for axis in self._axes:
            counts = round(axis.position / axis.unit)
            self._link.send(RPDO1_ID + axis.node.node_id, RPDO.pack(QUICK_STOP, counts))
        self._send_sync(self._cycle + 1)

    def _send_sync(self, cycle: int) -> None:
        self._link.send(SYNC_ID, bytes((sync_counter(cycle),)) if self._counted else b"")

    def _judge(self) -> None:
        """Say whether all answered the last SYNC: raises StaleError where too many did not."""
        if self._judged:
            return
        self._judged = True
        if self._waiting:
            self.watch.missing()
        else:
            self.watch.fresh()

    def _take(self, can_id: int, data: bytes) -> None:
        axis = self._by_id[can_id]
        if len(data) != TPDO.size:
            self.watch.reject(Rejected.LENGTH)
        elif axis.came:
            self.watch.reject(Rejected.REPEATED)
        else:
            axis.came, axis.data = True, bytes(data)
            self._waiting -= 1
            if not self._waiting:
                # Together or not at all: at speed, positions of two SYNCs would look like a skew.
                for each in self._axes:
                    each.take(self._sync_cycle)

    def _check(self) -> None:
        now_s = perf_counter()
        for axis in self._axes:
            if axis.error:
                raise DriveError(f"{axis.node.what}: emergency, error code 0x{axis.error:04X}")
            state = state_of(axis.status)
            if state is not DriveStates.OPERATION_ENABLED:
                raise DriveError(
                    f"{axis.node.what}: expected operation enabled, "
                    f"found {state.words if state else f'statusword 0x{axis.status:04X}'}"
                )
            if now_s - axis.heard_s > _MISSED_HEARTBEATS * self._options.heartbeat_s:
                raise DriveError(f"{axis.node.what}: no heartbeat")
        x1, x2, _ = self._axes
        check_skew(self.what, x1.position, x2.position, self._options.skew_m)


class _Axis:
    """What one drive said last, in SI units but for its force, which is in counts."""

    def __init__(self, node: DriveNode, unit: float, every: int, sync_s: float) -> None:
        self.node, self.unit, self._every = node, unit, every
        self._differences = Differences(sync_s)
        self.came, self.data = False, b""
        self.begin(0)

    def begin(self, counts: int) -> None:
        """Begin anew at rest."""
        self.position, self.velocity, self.force = counts * self.unit, 0.0, 0
        self.status, self.error = DriveStates.OPERATION_ENABLED.value[1], 0
        self.cycle, self.heard_s = 0, perf_counter()
        self._differences.at_rest(self.position)

    def take(self, cycle: int) -> None:
        """Take over what came with the SYNC of `cycle`."""
        regular, self.cycle = cycle - self.cycle == self._every, cycle
        self.status, counts, self.force = TPDO.unpack(self.data)
        self.position = counts * self.unit
        differences = self._differences
        go_on = differences.push if regular else differences.resume
        self.velocity, _ = go_on(self.position)

    def emergency(self, _: int, data: bytes) -> None:
        if len(data) == 8:
            self.error = _EMERGENCY.unpack_from(data)[0]

    def heartbeat(self, _: int, data: bytes) -> None:  # noqa: ARG002
        self.heard_s = perf_counter()
