"""Gantry and rotor on CANopen drives: exchange targets and positions by PDO, check every cycle."""

from __future__ import annotations

import struct
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from time import perf_counter, sleep

import numpy as np

from ...config.buses import CanDriveOptions
from ...config.rig import RigConfig
from ...wire.can.cia402 import (
    EMERGENCY_ID,
    ENABLE_OPERATION,
    HEARTBEAT_ID,
    POSITION_M,
    POSITION_RAD,
    QUICK_STOP,
    RPDO,
    RPDO1_ID,
    SYNC_ID,
    TPDO,
    TPDO1_ID,
    DriveStates,
    Node,
    beam_limits,
    rotor_limits,
    state_of,
    sync_counter,
)
from ...wire.frame_rejection_reasons import Rejected
from ...wire.velocity_from_positions import Differences, most_bend
from ..base import Array, DriveError, DriverError, FirstError, LinkError, ManipulatorDrives
from ..reading_checks import check_skew
from ..stale_readings import Watch
from .bus_link import CanLink
from .canopen_homing_and_enabling import Answers, DriveNode

_EMERGENCY = struct.Struct("<HB")
_MISSED_HEARTBEATS = 3.0
_HOMING_S = 10.0
_POLL_S = 0.005
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
        # Counted in SYNCs, one in every n-th cycle; at least one may be missing.
        tolerated = max(stale_cycles // options.every, min(stale_cycles, 1))
        self.watch = Watch(self.what, tolerated)
        self._link, self._options, self._deadline = link, options, deadline
        self._limits, self._period_s = rig.limits, 1.0 / rig.rate_hz
        self._sync_s = self._period_s * options.every
        self._cycle, self._sync_cycle, self._answer_due = 0, -options.every, 0
        self._sync_number = -1
        # Position, velocity, acceleration (2, 3) of beam and rotor that the loop wrote last.
        self._setpoint = np.zeros((2, 3))
        self._written: int | None = None
        self._targets_sent = False
        eds = folder / options.eds if options.eds else None
        numbers = options.nodes.model_dump()
        self._nodes = [DriveNode(name, number, eds, link) for name, number in numbers.items()]
        beam, rotor = rig.limits.beam_acceleration_m_s2, rig.limits.rotor_acceleration_rad_s2
        units = (POSITION_M, POSITION_M, POSITION_RAD)
        self._axes = [
            _Axis(node, unit, options.every, self._sync_s, most)
            for node, unit, most in zip(self._nodes, units, (beam, beam, rotor), strict=True)
        ]
        self._counted = False
        self._by_id = {TPDO1_ID + axis.node.node_id: axis for axis in self._axes}
        for axis in self._axes:
            node_id = axis.node.node_id
            link.listen(TPDO1_ID + node_id, self._handle_tpdo)
            link.listen(EMERGENCY_ID + node_id, axis.emergency)
            link.listen(HEARTBEAT_ID + node_id, axis.heartbeat)
        self._waiting = 0
        self._late = False
        self._checked = True
        self._stopped = False

    def sync(self, cycle: int) -> None:
        """Send SYNC in every n-th cycle (`every`), or in the first cycle after a skipped one.

        Raises StaleError after too many missing positions, LinkError if the bus is lost.
        """
        self._cycle = cycle
        number = cycle // self._options.every
        if number == self._sync_number:
            return
        first = FirstError()
        with first:
            self._check_answers()
        self.watch.begin()
        self._waiting, self._late = len(self._axes), False
        for axis in self._axes:
            axis.received = False
        # Slower drives have until the next SYNC to answer.
        self._answer_due = cycle if self._options.every == 1 else self._sync_cycle
        self._checked, self._sync_cycle, self._sync_number = False, cycle, number
        self._send_missed_targets()
        self._targets_sent = False
        self._send_sync(number)
        first.raise_it()

    def write(self, beam: Array, rotor: Array) -> None:
        """Send targets, which the drives reach at the SYNC after the next one."""
        self._setpoint[0], self._setpoint[1], self._written = beam, rotor, self._cycle
        if (self._cycle + 1) // self._options.every != self._sync_number:
            self._send_targets(self._cycle)

    def read(self, beam: Array, rotor: Array) -> None:
        """Fill beam (3,) with m, m/s, N and rotor (3,) with rad, rad/s, N m of the last SYNC.

        Raises:
            StaleError: positions were missing in too many consecutive cycles.
            DriveError: a drive is in fault or silent, or the gantry is skewed; raised once until
                `recover`.
        """
        every_cycle = self._options.every == 1
        if every_cycle:
            deadline_s, link = self._deadline(), self._link
            # A bus that is busy with other frames never runs empty: stop at the deadline.
            while self._waiting and link.receive(deadline_s) and link.received_s <= deadline_s:
                pass
        first = FirstError()
        # Also without readings: if one drive has left the bus, the others have to switch off.
        with first:
            if not self._stopped:
                self._stopped = True
                try:
                    self._check()
                except DriveError:
                    if not every_cycle:  # the next targets are sent some cycles later
                        with suppress(LinkError):
                            self.release()
                    raise
                self._stopped = False
        with first:
            if every_cycle:
                self._check_answers()
            self._fill(beam, rotor)
        first.raise_it()

    def recover(self) -> None:
        """Compare limits, map PDOs, home and enable every drive; raises DriverError.

        If one drive fails, all are switched off.
        """
        try:
            with Answers(self._nodes):
                self._configure()
                x1, x2, phi = self._nodes
                self._home(x1, x2)
                self._home(phi)
                for axis in self._axes:
                    axis.node.follow()
                    axis.begin(axis.node.position())
        except DriverError:
            with suppress(LinkError):
                self.release()
            raise
        self.watch.reset()
        self._checked, self._stopped, self._written = True, False, None

    def release(self) -> None:
        """Brake the drives and switch them off: at once by SDO, and by PDO with the next SYNC.

        No extra SYNC is sent: its positions would belong to no cycle. Until `recover`, `write`
        sends quick stops only. Raises LinkError.
        """
        self._stopped = True
        for axis in self._axes:
            axis.node.stop()
            counts = round(axis.position / axis.unit)
            self._link.send(RPDO1_ID + axis.node.node_id, RPDO.pack(QUICK_STOP, counts))

    def leave(self) -> None:
        """Release the drives, and send a last SYNC; raises LinkError."""
        self.release()
        self._sync_number += 1
        self._send_sync(self._sync_number)

    def _fill(self, beam: Array, rotor: Array) -> None:
        """Fill beam and rotor for this cycle, from the last positions of the drives."""
        x1, x2, phi = self._axes
        self.stale = self.STALE if x1.cycle < self._answer_due else 0
        # Between the readings of slow drives, the position is extrapolated at constant velocity.
        since_s = (self._cycle - x1.cycle) * self._period_s
        beam[0] = 0.5 * (x1.position + x2.position + since_s * (x1.velocity + x2.velocity))
        beam[1] = 0.5 * (x1.velocity + x2.velocity)
        beam[2] = x1.force + x2.force
        rotor[0] = phi.position + since_s * phi.velocity
        rotor[1] = phi.velocity
        rotor[2] = phi.force

    def _configure(self) -> None:
        options = self._options
        heartbeat_ms, expire_ms = (round(1e3 * s) for s in (options.heartbeat_s, options.expire_s))
        beam, rotor = beam_limits(self._limits), rotor_limits(self._limits)
        for node, limits in zip(self._nodes, (beam, beam, rotor), strict=True):
            node.configure(limits, heartbeat_ms, expire_ms, self._sync_s)
        counted = [node.name for node in self._nodes if node.counts_syncs]
        if 0 < len(counted) < len(self._nodes):
            raise DriverError(
                f"{self.what}: expected the same SYNC_OVERFLOW (0x1019) in all drives, found a "
                f"counted SYNC only in {', '.join(counted)}"
            )
        self._counted = bool(counted)

    def _home(self, *together: DriveNode) -> None:
        """Home drives together: the two motors of the gantry must move at the same time."""
        for node in together:
            node.enable(self._options.homing_method)
        for axis in self._axes:
            axis.error = 0  # it occurred before the reset
        for node in together:
            node.start_homing()
        give_up_s = perf_counter() + _HOMING_S
        begin: list[float] | None = None
        attained_before: list[bool | None] = []
        while True:
            at_m = _positions(together)
            attained, done = zip(*(node.homing() for node in together), strict=True)
            for axis in self._axes:
                if axis.node in together:
                    axis.check_homing()
            # An origin has changed or is about to: compare displacements from here on.
            if list(attained) != attained_before or None in attained:
                begin, attained_before = None, list(attained)
            elif begin is None:
                begin = at_m
            else:
                self._check_skew(*(m - m0 for m, m0 in zip(at_m, begin, strict=True)))
            if all(done):
                break
            if perf_counter() > give_up_s:
                raise DriveError(
                    f"{together[done.index(False)].what}: not homed after {_HOMING_S:g} s by "
                    f"method {self._options.homing_method}"
                )
            sleep(_POLL_S)

    def _check_skew(self, x1_m: float, *x2_m: float) -> None:
        for other_m in x2_m:
            check_skew(self.what, x1_m, other_m, self._options.skew_m)

    def _send_missed_targets(self) -> None:
        """Send targets if the cycle that should have sent them was skipped.

        Not after a whole SYNC period without targets: the drives have stopped by then, and their
        position is unknown.
        """
        last = self._cycle - 1
        if self._targets_sent or self._written is None:
            return
        if 0 < last - self._written < self._options.every:
            self._send_targets(last)

    def _send_targets(self, cycle: int) -> None:
        """Send the last setpoint, extrapolated to `cycle`."""
        assert self._written is not None
        # The setpoint is for the end of the next period; with a SYNC in every n-th cycle the drive
        # reaches its target later, so the target is further ahead.
        ahead_s = self._sync_s + (cycle - self._written - 1) * self._period_s
        p, v, a = self._setpoint.T
        x_m, phi_rad = (p + ahead_s * (v + 0.5 * ahead_s * a)).tolist()
        # If one drive is in fault, the others stop too.
        word = QUICK_STOP if self._stopped else ENABLE_OPERATION
        for axis, target in zip(self._axes, (x_m, x_m, phi_rad), strict=True):
            counts = min(max(round(target / axis.unit), -_MOST), _MOST)
            self._link.send(RPDO1_ID + axis.node.node_id, RPDO.pack(word, counts))
        self._targets_sent = True

    def _send_sync(self, number: int) -> None:
        self._link.send(SYNC_ID, bytes((sync_counter(number),)) if self._counted else b"")

    def _check_answers(self) -> None:
        """Check that all drives answered the last SYNC; raises StaleError after too many misses."""
        if self._checked:
            return
        self._checked = True
        if self._late:
            self.watch.late()
        if self._waiting or self._late:
            self.watch.missing()
        else:
            self.watch.fresh()

    def _handle_tpdo(self, can_id: int, data: bytes) -> None:
        axis = self._by_id[can_id]
        if len(data) != TPDO.size:
            self.watch.reject(Rejected.LENGTH)
        elif axis.received:
            self.watch.reject(Rejected.REPEATED)
        else:
            axis.received, axis.data = True, bytes(data)
            self._waiting -= 1
            if self._options.every == 1 and self._link.received_s > self._deadline():
                self._late = True  # the time of sampling is unknown
            if not self._waiting and not self._late:
                # Update all axes together: positions of two SYNCs would look like a skew.
                for each in self._axes:
                    each.update(self._sync_cycle)

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
            if axis.left is not None:
                words = axis.left.words if isinstance(axis.left, Node) else f"{axis.left}"
                raise DriveError(f"{axis.node.what}: expected NMT state operational, found {words}")
            if now_s - axis.heard_s > _MISSED_HEARTBEATS * self._options.heartbeat_s:
                raise DriveError(f"{axis.node.what}: no heartbeat for {now_s - axis.heard_s:.2f} s")
        x1, x2, _ = self._axes
        check_skew(self.what, x1.position, x2.position, self._options.skew_m)


def _positions(together: tuple[DriveNode, ...]) -> list[float]:
    """Return positions in m, interpolated to the same time.

    Drives are read one after the other: the first one is read before and after the second.
    """
    before, *second = (node.position() for node in together)
    after = together[0].position() if second else before
    return [POSITION_M * counts for counts in (0.5 * (before + after), *second)]


_NMT_STATE = 0x7F
_NMT_STATES = frozenset(Node)


class _Axis:
    """Last state and position of one drive, in SI units."""

    def __init__(
        self, node: DriveNode, unit: float, every: int, sync_s: float, acceleration: float
    ) -> None:
        self.node, self.unit, self._every = node, unit, every
        self._differences = Differences(sync_s, most_bend(acceleration, sync_s, unit))
        self.received, self.data = False, b""
        self.begin(0)

    def begin(self, counts: int) -> None:
        """Start at rest at position `counts`."""
        self.position, self.velocity, self.force = counts * self.unit, 0.0, 0.0
        self.status, self.error = DriveStates.OPERATION_ENABLED.value[1], 0
        self.left: int | None = None
        self._operational = False
        self.cycle, self.heard_s = -self._every, perf_counter()
        self._differences.at_rest(self.position)

    def check_homing(self) -> None:
        """Raise DriveError if the drive has sent an emergency."""
        if self.error:
            raise DriveError(f"{self.node.what}: emergency, error code 0x{self.error:04X}")

    def update(self, cycle: int) -> None:
        """Update state, position and velocity from the TPDO of the SYNC in `cycle`."""
        regular, self.cycle = cycle - self.cycle == self._every, cycle
        self.status, counts, per_mille = TPDO.unpack(self.data)
        self.position = counts * self.unit
        self.force = per_mille * 1e-3 * self.node.rated
        differences = self._differences
        go_on = differences.push if regular else differences.resume
        self.velocity, _ = go_on(self.position)

    def emergency(self, _: int, data: bytes) -> None:
        if len(data) == 8:
            self.error = _EMERGENCY.unpack_from(data)[0]

    def heartbeat(self, _: int, data: bytes) -> None:
        """Note a heartbeat; `left` is the NMT state that the drive went to from operational."""
        self.heard_s = perf_counter()
        state = data[0] & _NMT_STATE if data else -1
        if state == Node.OPERATIONAL:
            self._operational = True
        elif self._operational or state == Node.BOOT_UP:
            self.left = Node(state) if state in _NMT_STATES else state
