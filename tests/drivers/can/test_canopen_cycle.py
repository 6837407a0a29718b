"""Drives in the cycle, on a bus that a test plays: deadlines, skipped cycles, heartbeats."""

from __future__ import annotations

import math
import time
from collections import deque
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from levid.config.rig import RigConfig, load_rig
from levid.config.shipped import shipped
from levid.drivers.base import DriveError, DriverError, StaleError
from levid.drivers.can.bus_link import CanLink
from levid.drivers.can.canopen_drives import CanDrives
from levid.drivers.can.canopen_homing_and_enabling import DriveNode
from levid.drivers.stale_readings import Watch
from levid.log.signals import Stale
from levid.wire.can.cia402 import (
    EMERGENCY_ID,
    ENABLE_OPERATION,
    HEARTBEAT_ID,
    POSITION_M,
    QUICK_STOP,
    RPDO,
    RPDO1_ID,
    SDO_ANSWER_ID,
    SDO_REQUEST_ID,
    SYNC_ID,
    TPDO,
    TPDO1_ID,
    DriveStates,
    Node,
)
from levid.wire.can.kernel_frame import ReceivedFrame

OPERATING = DriveStates.OPERATION_ENABLED.value[1]
FAULT = DriveStates.FAULT.value[1]


class Wire:
    """A bus that keeps what is sent, and brings what a test puts there."""

    def __init__(self) -> None:
        self.sent: list[tuple[int, bytes]] = []
        self.coming: deque[ReceivedFrame] = deque()
        self.always: ReceivedFrame | None = None

    def send(self, can_id: int, data: bytes) -> None:
        self.sent.append((can_id, data))

    def receive(self, _: float) -> ReceivedFrame | None:
        return self.coming.popleft() if self.coming else self.always

    def shutdown(self) -> None:
        return

    def answer(self, position: int, stamp_s: float, status: int = OPERATING) -> None:
        data = TPDO.pack(status, position, 0)
        self.coming.extend(ReceivedFrame(TPDO1_ID + i, data, stamp_s) for i in (1, 2, 3))

    def targets(self) -> list[tuple[int, int]]:
        """Controlwords and positions of X1 that were sent since the last call."""
        found = [RPDO.unpack(data) for can_id, data in self.sent if can_id == RPDO1_ID + 1]
        self.sent.clear()
        return found


class Bench:
    """Drives on a bus that a test plays; they count SYNCs as if they had been configured so."""

    def __init__(self, rig: RigConfig, every: int, stale_cycles: int = 2) -> None:
        options = rig.on_bus("drives")[1].model_copy(update={"every": every})
        self.wire, self.deadline_s = Wire(), math.inf
        self.link = CanLink("main", rig.can[options.bus], self.wire)
        self.drives = CanDrives(
            self.link, rig, options, Path(), stale_cycles, lambda: self.deadline_s
        )
        self.drives._counted = True
        self.beam, self.rotor = np.zeros(3), np.zeros(3)

    def read(self) -> None:
        self.drives.read(self.beam, self.rotor)


@pytest.fixture
def rig() -> RigConfig:
    return load_rig(shipped("rigs/canfd.yaml"))


def test_answer_after_its_deadline_is_stale(rig: RigConfig) -> None:
    """The timestamp decides, not the time at which this process reads the frame."""
    bench = Bench(rig, 1)
    with pytest.raises(StaleError, match="too late"):  # noqa: PT012
        for k in range(3):
            bench.deadline_s = time.perf_counter() - 0.1
            bench.drives.sync(k)
            bench.wire.answer(1000, time.time() - 0.01)
            bench.read()
            assert bench.beam[0] == 0.0
            assert bench.drives.stale == Stale.DRIVES
    assert bench.drives.watch.stale == 3


def test_answer_in_time_counts_however_late_it_is_read(rig: RigConfig) -> None:
    bench = Bench(rig, 1)
    bench.drives.sync(0)
    bench.deadline_s = time.perf_counter() - 0.1
    bench.wire.answer(1000, time.time() - 0.5)
    bench.read()
    assert bench.beam[0] == pytest.approx(1000 * POSITION_M)
    assert bench.drives.stale == 0


def test_read_ends_at_its_deadline_on_a_busy_bus(rig: RigConfig) -> None:
    bench = Bench(rig, 1)
    bench.wire.always = ReceivedFrame(0x7F0, b"", 0.0)
    bench.drives.sync(0)
    bench.deadline_s = time.perf_counter() + 0.01
    bench.read()  # it must return
    assert bench.drives.stale == Stale.DRIVES


@pytest.mark.parametrize("stamped", [False, True])
def test_draining_ends_on_a_busy_bus(rig: RigConfig, stamped: bool) -> None:
    wire, seen = Wire(), []
    link = CanLink("main", rig.can["main"], wire)
    link.listen(0x7F0, lambda *_: seen.append(time.time()))

    def busy(_: float) -> ReceivedFrame:
        return ReceivedFrame(0x7F0, b"", time.time() if stamped else 0.0)

    wire.receive = busy  # type: ignore[method-assign]
    link.drain()
    assert len(seen) <= 1000


def test_second_listener_of_an_id_is_refused(rig: RigConfig) -> None:
    link = CanLink("main", rig.can["main"])
    link.listen(0x181, lambda *_: None)
    with pytest.raises(DriverError, match="ID 0x181 is used by two devices"):
        link.listen(0x181, lambda *_: None)


def test_sdo_answers_without_a_request_are_not_kept(
    rig: RigConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A quick stop by SDO is answered too, and other masters may read a drive."""
    wire, kept = Wire(), []
    link = CanLink("main", rig.can["main"], wire)
    node = DriveNode("x1", 1, None, link)
    monkeypatch.setattr("canopen.Network.notify", lambda *answer: kept.append(answer))
    for waits, so_far in ((None, 0), (True, 1), (False, 1)):
        if waits is not None:
            node.listen(waits)
        wire.coming.append(ReceivedFrame(SDO_ANSWER_ID + 1, bytes(8), time.time()))
        link.drain()
        assert len(kept) == so_far


def syncs(wire: Wire) -> list[int]:
    return [data[0] for can_id, data in wire.sent if can_id == SYNC_ID]


def test_syncs_are_sent_at_multiples_and_counted_by_one(rig: RigConfig) -> None:
    bench = Bench(rig, 4)
    bench.drives.watch = Watch("drives", 100)  # nobody answers
    for k in (0, 0, 1, 2, 3, 4, 5, 6, 9, 10, 11, 12, 13):  # 7 and 8 were skipped
        before = len(syncs(bench.wire))
        bench.drives.sync(k)
        sent = len(syncs(bench.wire)) - before
        assert sent == (k in (0, 4, 9, 12) and not (k == 0 and before))
    assert syncs(bench.wire) == [1, 2, 3, 4]


@pytest.mark.parametrize("released", [4, 5, 7])
def test_release_sends_no_extra_sync(rig: RigConfig, released: int) -> None:
    """The next regular SYNC would have the same counter, which drives may detect as a fault."""
    bench = Bench(rig, 4)
    bench.drives.watch = Watch("drives", 100)
    for k in range(17):
        bench.drives.sync(k)
        if k == released:
            before = len(bench.wire.sent)
            bench.drives.release()
            sent = bench.wire.sent[before:]
            assert {can_id for can_id, _ in sent} == {
                base + node for base in (SDO_REQUEST_ID, RPDO1_ID) for node in (1, 2, 3)
            }
    assert syncs(bench.wire) == [1, 2, 3, 4, 5]


def test_leave_sends_quick_stops_and_the_next_sync(rig: RigConfig) -> None:
    bench = Bench(rig, 4)
    for k in range(6):
        bench.drives.sync(k)
    bench.wire.sent.clear()
    bench.drives.leave()
    *stops, (last, counter) = bench.wire.sent
    ids = [RPDO1_ID + node for node in (1, 2, 3)]
    assert [RPDO.unpack(data)[0] for can_id, data in stops if can_id in ids] == [QUICK_STOP] * 3
    assert (last, counter) == (SYNC_ID, b"\x03")


@pytest.mark.parametrize("written", [1, 2])
def test_targets_of_a_skipped_cycle_are_extrapolated(rig: RigConfig, written: int) -> None:
    """The drives get a target for every SYNC, as if no cycle had been skipped."""
    T, speed, acceleration = 1 / rig.rate_hz, 0.1, 2.0

    def setpoint(k: int) -> np.ndarray:
        t = k * T
        return np.array(
            [speed * t + 0.5 * acceleration * t * t, speed + acceleration * t, acceleration]
        )

    skipped, whole = Bench(rig, 4), Bench(rig, 4)
    for bench, cycles in ((skipped, range(written + 1)), (whole, range(4))):
        for k in cycles:
            bench.drives.sync(k)
            bench.drives.write(setpoint(k), np.zeros(3))
        bench.drives.sync(4)
    (expected,) = whole.wire.targets()
    *targets, (last, _) = skipped.wire.sent
    assert last == SYNC_ID
    assert skipped.wire.targets() == [expected]
    assert len(targets) == 4  # the first SYNC, and three targets before the second
    assert expected[1] > 0


def test_targets_before_a_stall_are_not_extrapolated(rig: RigConfig) -> None:
    """After a stall the drives stand still; the next targets follow the present reference."""
    bench = Bench(rig, 4)
    bench.drives.sync(0)
    bench.drives.write(np.array([0.0, 0.1, 0.0]), np.zeros(3))
    bench.drives.sync(500)
    assert bench.wire.targets() == []


def test_all_drives_get_a_quick_stop_if_one_is_in_fault(rig: RigConfig) -> None:
    bench = Bench(rig, 1)
    bench.drives.sync(0)
    bench.wire.answer(0, time.time())
    bench.read()
    bench.drives.write(np.zeros(3), np.zeros(3))
    assert [word for word, _ in bench.wire.targets()] == [ENABLE_OPERATION]
    bench.drives.sync(1)
    bench.wire.answer(0, time.time(), FAULT)
    with pytest.raises(DriveError, match="found fault"):
        bench.read()
    bench.drives.write(np.zeros(3), np.zeros(3))
    assert [word for word, _ in bench.wire.targets()] == [QUICK_STOP]


@pytest.mark.parametrize("every", [1, 4])
@pytest.mark.parametrize("how", ["heartbeat", "emergency"])
def test_other_drives_stop_if_one_has_left_the_bus(
    rig: RigConfig, every: int, how: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its readings are missing in every cycle, which is another error."""
    bench = Bench(rig, every)
    raised: list[Exception] = []
    for k in range(8 * every):
        if k != 5 * every:  # by then more readings are missing than are tolerated
            pass
        elif how == "heartbeat":
            later = partial(float, time.perf_counter() + 1.0)  # five periods of it
            monkeypatch.setattr("levid.drivers.can.canopen_drives.perf_counter", later)
        else:
            error = ReceivedFrame(EMERGENCY_ID + 1, bytes((0x05, 0x73, 1)) + bytes(5), time.time())
            bench.wire.coming.append(error)
            bench.link.drain()
        for call in (
            lambda k=k: bench.drives.sync(k),
            bench.read,
            lambda: bench.drives.write(np.zeros(3), np.zeros(3)),
        ):
            try:
                call()
            except DriverError as error:
                raised.append(error)
        if not k % every:
            data = TPDO.pack(OPERATING, 0, 0)
            bench.wire.coming.extend(ReceivedFrame(TPDO1_ID + i, data, time.time()) for i in (2, 3))
        while bench.wire.coming:
            bench.link.drain()
    words = [RPDO.unpack(d)[0] for i, d in bench.wire.sent if i == RPDO1_ID + 2]
    drive = [error for error in raised if isinstance(error, DriveError)]
    assert len(drive) == 1  # raised once
    assert ("no heartbeat" if how == "heartbeat" else "0x7305") in str(drive[0])
    assert any(isinstance(error, StaleError) for error in raised)
    assert words[-1] == QUICK_STOP


def test_released_drives_get_quick_stops_only(rig: RigConfig) -> None:
    """The loop continues its cycles if a fault cannot be cleared."""
    bench = Bench(rig, 1)
    bench.drives.release()
    assert [word for word, _ in bench.wire.targets()] == [QUICK_STOP]
    for k in range(3):
        bench.drives.sync(k)
        bench.wire.answer(0, time.time(), DriveStates.SWITCH_ON_DISABLED.value[1])
        bench.read()
        bench.drives.write(np.zeros(3), np.zeros(3))
        assert [word for word, _ in bench.wire.targets()] == [QUICK_STOP]


@pytest.mark.parametrize(
    ("said", "fault"),
    [
        ((Node.OPERATIONAL, Node.OPERATIONAL), ""),
        ((Node.PRE_OPERATIONAL, Node.OPERATIONAL), ""),  # sent before it was started
        ((Node.BOOT_UP,), "boot-up"),
        ((Node.OPERATIONAL, Node.PRE_OPERATIONAL), "pre-operational"),
        ((Node.OPERATIONAL, Node.STOPPED, Node.OPERATIONAL), "stopped"),
    ],
)
def test_node_that_leaves_operational_state_is_a_fault(
    rig: RigConfig, said: tuple[Node, ...], fault: str
) -> None:
    bench = Bench(rig, 1)
    for state in said:
        bench.wire.coming.append(ReceivedFrame(HEARTBEAT_ID + 2, bytes((state,)), time.time()))
    bench.link.drain()
    bench.drives.sync(0)
    bench.wire.answer(0, time.time())
    if fault:
        with pytest.raises(
            DriveError, match=f"drive x2.*expected NMT state operational, found {fault}"
        ):
            bench.read()
    else:
        bench.read()


@pytest.mark.parametrize(("silent", "name"), [(1, "x1"), (2, "x2"), (3, "phi")])
def test_drive_without_heartbeats_is_a_fault(
    rig: RigConfig, monkeypatch: pytest.MonkeyPatch, silent: int, name: str
) -> None:
    bench = Bench(rig, 1)
    later = partial(float, time.perf_counter() + 1.0)  # five periods of it
    monkeypatch.setattr("levid.drivers.can.canopen_drives.perf_counter", later)
    for node in {1, 2, 3} - {silent}:
        state = bytes((Node.OPERATIONAL,))
        bench.wire.coming.append(ReceivedFrame(HEARTBEAT_ID + node, state, time.time()))
    bench.drives.sync(0)
    bench.wire.answer(0, time.time())
    with pytest.raises(DriveError, match=rf"drive {name} \(node {silent}\).*no heartbeat"):
        bench.read()


@pytest.mark.parametrize("every", [1, 4])
def test_other_drives_are_stopped_in_the_cycle_of_a_fault(rig: RigConfig, every: int) -> None:
    """Even if the next targets are some cycles away: the second motor of the gantry is powered."""
    bench = Bench(rig, every)
    bench.drives.sync(0)
    bench.wire.answer(0, time.time(), DriveStates.FAULT.value[1])
    bench.wire.sent.clear()
    cycles = 0
    with pytest.raises(DriveError):  # noqa: PT012
        while True:
            bench.read()
            bench.drives.write(np.zeros(3), np.zeros(3))
            cycles += 1
            bench.link.drain()  # as the backend does first
            bench.drives.sync(cycles)
    bench.drives.write(np.zeros(3), np.zeros(3))
    assert cycles <= 1  # slower drives have until the next cycle to answer
    assert QUICK_STOP in [word for word, _ in bench.wire.targets()]


@pytest.mark.parametrize(("every", "stale_cycles", "syncs"), [(1, 2, 2), (4, 20, 5), (4, 2, 1)])
def test_stale_cycles_are_limited_for_slow_drives_too(
    rig: RigConfig, every: int, stale_cycles: int, syncs: int
) -> None:
    bench = Bench(rig, every, stale_cycles)
    bench.deadline_s = 0.0
    k = 0
    with pytest.raises(StaleError):  # noqa: PT012
        for k in range(100):
            bench.drives.sync(k)
            bench.read()
    # `syncs` answers may be missing; the next SYNC after one more raises the error.
    assert k == (syncs + 1) * every if every > 1 else k == syncs


def test_positions_are_used_once_all_three_of_a_sync_are_received(rig: RigConfig) -> None:
    """A beam at speed is not skewed because X1 of this SYNC is read beside X2 of the last."""
    bench = Bench(rig, 4)
    moved = round(1.2e-3 / POSITION_M)  # twelve times the skew that is allowed

    def answer(node: int, counts: int) -> None:
        data = TPDO.pack(OPERATING, counts, 0)
        bench.wire.coming.append(ReceivedFrame(TPDO1_ID + node, data, time.time()))
        bench.link.drain()
        bench.read()

    bench.drives.sync(4)
    answer(1, moved)
    assert bench.beam[0] == 0.0
    answer(2, moved)
    answer(3, 0)
    assert bench.beam[0] == pytest.approx(1.2e-3, abs=1e-9)
