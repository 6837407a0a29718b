"""What a host makes of CANopen drives, cycle by cycle: state, motion, and when it stops them.

An error of a drive lasts until the drive reports none; positions count if all three arrive. The
fault must be raised in the first cycle that shows it, once, and from then on all drives get quick
stops. Numbers are those of CiA 301 and 402.
"""

from __future__ import annotations

import math
import struct
from pathlib import Path

import numpy as np
import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, rule
from independent_frame_decoder import CHANGES, changed

from levid.config.rig import load_rig
from levid.config.shipped import shipped
from levid.drivers.base import DriveError
from levid.drivers.can.bus_link import CanLink
from levid.drivers.can.canopen_drives import CanDrives
from levid.wire.can.kernel_frame import ReceivedFrame

NODES = (1, 2, 3)
EMERGENCY, TPDO, RPDO, HEARTBEAT = 0x080, 0x180, 0x200, 0x700
ENABLED, ENABLED_MASK = 0x27, 0x6F
STOP, GO_ON = 0x02, 0x0F
UNITS = (1e-9, 1e-9, 1e-7)
OPERATIONAL = 0x05
STATES = st.sampled_from([b"\x05", b"\x05", b"\x85", b"\x00", b"\x04", b"\x7f"])
"""Of a heartbeat: operational, the same with the toggle bit, boot-up, stopped, pre-operational."""

RIG = load_rig(shipped("rigs/canfd.yaml"))
OPTIONS = RIG.on_bus("drives")[1].model_copy(update={"every": 1, "heartbeat_s": 1e6})
PERIOD_S = 1.0 / RIG.rate_hz
BENDS = [
    # The largest second difference of a motion: five times the limit of acceleration, which
    # extrapolated targets may need, and four counts of rounding. Beyond it a drive has made up
    # for a standstill.
    5.0 * PERIOD_S**2 * acceleration + 4.0 * unit
    for acceleration, unit in zip(
        (*[RIG.limits.beam_acceleration_m_s2] * 2, RIG.limits.rotor_acceleration_rad_s2),
        UNITS,
        strict=True,
    )
]
NODE = st.sampled_from(NODES)
COUNTS = st.one_of(
    st.integers(-1500, 1500),  # so near that from cycle to cycle it may be a motion
    st.integers(-(10**8), 10**8),  # anywhere within the rig's range
    st.integers(-(2**31), 2**31 - 1),
)
SKEW = st.one_of(st.integers(-1500, 1500), st.integers(-(10**6), 10**6))


class Wire:
    """A bus that brings what it is given, and keeps what is sent."""

    def __init__(self) -> None:
        self.coming: list[ReceivedFrame] = []
        self.sent: list[tuple[int, bytes]] = []

    def send(self, can_id: int, data: bytes) -> None:
        self.sent.append((can_id, data))

    def receive(self, _: float) -> ReceivedFrame | None:
        return self.coming.pop(0) if self.coming else None


LINK = CanLink("main", RIG.can[OPTIONS.bus])
DRIVES = CanDrives(LINK, RIG, OPTIONS, Path(), 1 << 30, lambda: math.inf)


class Axis:
    """Position and velocity of one drive by its last four samples."""

    def __init__(self, unit: float, bend: float) -> None:
        self.unit, self.bend = unit, bend
        self.last, self.velocity = (0.0, 0.0, 0.0), 0.0
        self.doubtful = False

    def sample(self, counts: int, regular: bool) -> None:
        p, (a, b, c) = counts * self.unit, self.last
        if not regular:  # the number of missing periods is unknown: the velocity stays
            step = self.velocity * PERIOD_S
            self.last = p, p - step, p - 2.0 * step
            return
        bend = max(abs((p - a) - (a - b)), abs((a - b) - (b - c)))
        self.doubtful = abs(bend - self.bend) < 1e-9 * self.bend  # rounding may decide it
        third_order = (11.0 * p - 18.0 * a + 9.0 * b - 2.0 * c) / (6.0 * PERIOD_S)
        self.velocity = (p - a) / PERIOD_S if bend > self.bend else third_order
        self.last = p, a, b


class DrivesOnANoisyBus(RuleBasedStateMachine):
    """Drives send emergencies, heartbeats and positions; `read` ends a cycle."""

    def __init__(self) -> None:
        super().__init__()
        self.wire = LINK._bus = Wire()
        self.drives, self.cycle = DRIVES, 0
        self.drives._sync_number = -1
        self.beam, self.rotor = np.zeros(3), np.zeros(3)
        self.recover()

    @rule()
    def recover(self) -> None:
        """Do as `CanDrives.recover`, without its exchange with drives by SDO."""
        drives = self.drives
        drives.watch.reset()
        drives._checked, drives._stopped, drives._written = True, False, None
        for axis in drives._axes:
            axis.begin(0)
        self.axes = [Axis(unit, bend) for unit, bend in zip(UNITS, BENDS, strict=True)]
        self.said: list[tuple[int, bytes]] = []
        self.places: list[tuple[int, bytes]] = []
        self.errors: dict[int, bool] = {}
        self.operational: set[int] = set()
        self.left = self.disabled = self.faulty = False
        self.answered = -1

    @rule(node=NODE, error=st.sampled_from([b"\0\0", b"\x05\x73"]), rest=st.binary(max_size=6))
    def emergency(self, node: int, error: bytes, rest: bytes) -> None:
        self.said.append((EMERGENCY + node, error + rest))
        if len(rest) == 6:  # a shorter one is none
            self.errors[node] = error != b"\0\0"

    @rule(node=NODE, data=st.one_of(STATES, st.binary(max_size=8)))
    def heartbeat(self, node: int, data: bytes) -> None:
        self.said.append((HEARTBEAT + node, data))
        state = data[0] & 0x7F if data else -1
        if state == OPERATIONAL:
            self.operational.add(node)
        else:
            self.left |= state == 0 or node in self.operational

    @rule(
        x=COUNTS, skew=SKEW, phi=COUNTS, order=st.permutations(NODES), other=st.integers(0, 2**16)
    )
    def positions(self, x: int, skew: int, phi: int, order: list[int], other: int) -> None:
        """All drives send a position, with operation enabled and any other bits."""
        x2 = min(max(x + skew, -(2**31)), 2**31 - 1)
        for node in order:
            counts = (x, x2, phi)[node - 1]
            self._place(node, (other & ~ENABLED_MASK | ENABLED) & 0xFFFF, counts)

    @rule(step=st.integers(1, 3), x=st.integers(-1500, 1500), phi=st.integers(-1500, 1500))
    def motion(self, step: int, x: int, phi: int) -> None:
        """Two cycles of a calm motion, so that velocities come to third order."""
        for k in (1, 2):
            self.positions(k * x, 0, k * phi, list(NODES), 0)
            self.read(step if k == 1 else 1, 0, 0, False)

    @rule(node=NODE, status=st.integers(0, 0xFFFF), counts=COUNTS)
    def position(self, node: int, status: int, counts: int) -> None:
        self._place(node, status, counts)

    @rule(node=NODE, counts=COUNTS, changes=CHANGES)
    def changed_position(self, node: int, counts: int, changes) -> None:
        self._place(node, ENABLED, counts)
        can_id, data = self.places.pop()
        self.places.append((can_id, changed(data, changes)))

    @rule(
        step=st.sampled_from([1, 1, 1, 2, 3]),
        x=st.integers(-(10**8), 10**8),
        phi=SKEW,
        recovers=st.booleans(),
    )
    def read(self, step: int, x: int, phi: int, recovers: bool) -> None:
        """End a cycle: read, compare, and send the targets x and phi in counts."""
        drives, wire = self.drives, self.wire
        wire.coming = [ReceivedFrame(*frame, 0.0) for frame in self.said + self.places]
        drives.sync(self.cycle)
        try:
            drives.read(self.beam, self.rotor)
            raised = False
        except DriveError:
            raised = True
        self._compare(raised)
        if any(axis.doubtful for axis in self.axes):
            self.recover()
        wire.sent.clear()
        drives.write(np.array([x * UNITS[0], 0.0, 0.0]), np.array([phi * UNITS[2], 0.0, 0.0]))
        word = STOP if self.faulty else GO_ON
        targets = zip(NODES, (x, x, phi), strict=True)
        assert wire.sent == [(RPDO + i, struct.pack("<Hi", word, to)) for i, to in targets]
        self.said, self.places = [], []
        self.cycle += step
        if self.faulty and recovers:
            self.recover()

    def _place(self, node: int, status: int, counts: int) -> None:
        self.places.append((TPDO + node, struct.pack("<Hih", status, counts, 0)))

    def _compare(self, raised: bool) -> None:
        whole: dict[int, tuple[int, int]] = {}
        for can_id, data in self.places:
            if len(data) == 8:
                whole.setdefault(can_id - TPDO, struct.unpack_from("<Hi", data))
        complete = len(whole) == len(NODES)
        assert bool(self.drives.stale) != complete
        if complete:
            regular, self.answered = self.cycle - self.answered == 1, self.cycle
            self.disabled = any(whole[i][0] & ENABLED_MASK != ENABLED for i in NODES)
            for node, axis in zip(NODES, self.axes, strict=True):
                axis.sample(whole[node][1], regular)
            if any(axis.doubtful for axis in self.axes):
                return
        x1, x2, phi = (axis.last[0] for axis in self.axes)
        askew = abs(x1 - x2) > OPTIONS.skew_m
        fault = any(self.errors.values()) or self.disabled or self.left or askew
        assert raised == (fault and not self.faulty)
        self.faulty |= fault
        # Between readings, positions are extrapolated at constant velocity.
        since_s = (self.cycle - self.answered) * PERIOD_S
        v1, v2, omega = (axis.velocity for axis in self.axes)
        expected = [
            0.5 * (x1 + x2 + since_s * (v1 + v2)), 0.5 * (v1 + v2), phi + since_s * omega, omega,
        ]  # fmt: skip
        # A position of 2 m has 16 digits, a velocity of differences over 1 ms 12 of them.
        found = [*self.beam[:2], *self.rotor[:2]]
        assert found == pytest.approx(expected, rel=1e-9, abs=1e-6)


TestDrivesOnANoisyBus = DrivesOnANoisyBus.TestCase
TestDrivesOnANoisyBus.settings = settings(max_examples=settings.default.max_examples // 10)
