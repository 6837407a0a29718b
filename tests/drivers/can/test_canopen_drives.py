"""CiA 402 drives: states as tables, limits compared, homing, slower drives, silence."""

from __future__ import annotations

import struct
import time
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from drives_at_rest_cycles import run, with_drives
from waiting import wait_until

from levid.config.base import ConfigError
from levid.config.buses import CanBus
from levid.config.rig import RigConfig
from levid.config.shipped import shipped
from levid.drivers.base import Context, Devices, DriveError, DriverError, LinkError, StaleError
from levid.drivers.can.bus_link import CanLink
from levid.drivers.can.canopen_homing_and_enabling import DriveNode
from levid.drivers.open_backends import check_backends, open_devices
from levid.sim.electronics.emulated_rig import Electronics
from levid.wire.can.cia402 import (
    NMT_ID,
    SDO_ANSWER_ID,
    SDO_REQUEST_ID,
    SYNC_COUNTER,
    TOWARDS_OPERATION,
    DriveStates,
    Object,
    beam_limits,
    cycle_of_sync,
    state_of,
    sync_counter,
)
from levid.wire.can.kernel_frame import ReceivedFrame
from levid.wire.device_protocol import CYCLES, DriveState
from levid.wire.velocity_from_positions import Differences

RATE_HZ = 100.0


pytestmark = pytest.mark.usefixtures("host_paced")


@pytest.fixture
def rig(rig_on, quiet_sim: Path) -> RigConfig:
    return rig_on("can", RATE_HZ, quiet_sim)


@pytest.mark.parametrize("state", DriveStates)
def test_statusword_gives_one_state(state: DriveStates) -> None:
    mask, value = state.value
    for noise in range(0x10000):
        word = value | (noise & ~mask & 0xFFFF)
        if noise & mask:
            continue
        assert state_of(word) is state


def test_every_state_has_a_transition_towards_operation() -> None:
    after = {
        DriveStates.FAULT: DriveStates.SWITCH_ON_DISABLED,
        DriveStates.QUICK_STOP_ACTIVE: DriveStates.SWITCH_ON_DISABLED,
        DriveStates.SWITCH_ON_DISABLED: DriveStates.READY_TO_SWITCH_ON,
        DriveStates.READY_TO_SWITCH_ON: DriveStates.SWITCHED_ON,
        DriveStates.SWITCHED_ON: DriveStates.OPERATION_ENABLED,
    }
    assert set(after) == set(TOWARDS_OPERATION)


@pytest.mark.parametrize("every", range(1, 101))
def test_counters_of_the_buses_stay_in_step(every: int) -> None:
    """The counter of a SYNC gives the cycle modulo 240 SYNCs."""
    counters = [sync_counter(number) for number in range(1000)]
    assert set(counters) == set(range(1, SYNC_COUNTER + 1))
    for number in (0, 239, 240, 255, 256, CYCLES - 1, CYCLES, 10**7 + 1):
        begins, modulus = cycle_of_sync(sync_counter(number), every)
        assert CYCLES % modulus == 0
        assert number * every % CYCLES % modulus == begins
        assert modulus >= SYNC_COUNTER


def test_differences_are_exact_for_a_cubic_and_a_quadratic() -> None:
    T = 0.01
    differences = Differences(T)
    for k in range(10):
        t = k * T
        velocity, _ = differences.push(1.0 + 2.0 * t - 3.0 * t**2 + 4.0 * t**3)
    assert velocity == pytest.approx(2.0 - 6.0 * t + 12.0 * t**2, rel=1e-9)
    for k in range(10):
        t = k * T
        _, acceleration = differences.push(1.0 + 2.0 * t - 3.0 * t**2)
    assert acceleration == pytest.approx(-6.0, rel=1e-6)


def test_position_after_a_late_target_keeps_the_last_speed() -> None:
    """One late target at 0.25 m/s: third-order differences would give 1 m/s, a fault."""
    T, v = 0.004, 0.25
    differences = Differences(T, 5.0 * 10.0 * T**2)
    steps = [differences.push(k * v * T)[0] for k in range(4)]
    assert steps[-1] == pytest.approx(v)
    after = [differences.push(p * v * T)[0] / v for p in (3, 5, 6, 7, 8)]
    assert after == pytest.approx([0.0, 2.0, 1.0, 1.0, 1.0])


def test_differing_limits_are_refused_and_named(rig: RigConfig) -> None:
    slower = rig.limits.model_copy(update={"beam_velocity_m_s": 0.4, "coil_n": 19.0})
    with (
        Electronics(rig.model_copy(update={"limits": slower}), Path()),
        pytest.raises(DriverError) as error,
    ):
        open_devices(Context(rig, 1 / RATE_HZ, Path()))
    # The amplifiers are compared first.
    assert "COIL_LIMIT_MN: expected 20000, found 19000" in str(error.value)
    only_drives = rig.limits.model_copy(update={"beam_velocity_m_s": 0.4})
    with (
        Electronics(rig.model_copy(update={"limits": only_drives}), Path()),
        pytest.raises(DriverError, match="MAX_SPEED: expected 500000000, found 400000000"),
    ):
        open_devices(Context(rig, 1 / RATE_HZ, Path()))


def test_limits_are_in_counts() -> None:
    limits = beam_limits(load().limits)
    assert limits[Object.POSITION_LIMIT, 2] == 100_000_000  # 0.1 m in nm
    assert limits[Object.MAX_ACCELERATION, 0] == 10_000  # 10 m/s2 in mm/s2


def load() -> RigConfig:
    from levid.config.rig import load_rig

    return load_rig(shipped("rigs/canfd.yaml"))


@pytest.mark.parametrize("can_id", [NMT_ID, SDO_REQUEST_ID + 1])
def test_empty_frame_does_not_end_the_electronics(rig: RigConfig, can_id: int) -> None:
    nodes_on(Electronics(rig, Path())).handle_frame(can_id, b"")  # in the thread that answers


class Answering:
    """A bus whose one node answers every request by SDO at once."""

    def __init__(self, answer: Callable[[bytes], bytes]) -> None:
        self.asked, self._answer = 0, answer
        self._coming: list[ReceivedFrame] = []
        self.link = CanLink("main", CanBus(interface="virtual", channel="sdo"), self)
        self.node = DriveNode("x1", 1, None, self.link)
        self.node.listen(True)

    def send(self, can_id: int, data: bytes) -> None:
        if can_id == SDO_REQUEST_ID + 1 and data[0] != 0x80:
            self.asked += 1
            self._coming.append(ReceivedFrame(SDO_ANSWER_ID + 1, self._answer(data), 0.0))
            self.link.receive(0.0)

    def receive(self, _: float) -> ReceivedFrame:
        return self._coming.pop()

    def shutdown(self) -> None:
        return


@pytest.mark.parametrize("length", [6, 8, 12])
def test_sdo_answer_has_eight_bytes(length: int) -> None:
    answer = struct.pack("<BHBi4x", 0x43, Object.ACTUAL_POSITION, 0, 1637)[:length]
    node = Answering(lambda _: answer).node
    if length == 8:
        assert node.position() == 1637
    else:
        with pytest.raises(LinkError, match="ACTUAL_POSITION"):
            node.position()


def test_endless_sdo_answer_is_a_lost_link() -> None:
    def segment(request: bytes) -> bytes:
        if request[0] & 0xE0 == 0x40:
            return struct.pack("<BHB4x", 0x40, Object.ACTUAL_POSITION, 0)
        return bytes((request[0] & 0x10, *range(1, 8)))  # toggled, and never the last

    bus = Answering(segment)
    with pytest.raises(LinkError, match="ACTUAL_POSITION"):
        bus.node.position()
    assert bus.asked < 20


def test_missing_node_is_named(rig: RigConfig) -> None:
    other = with_drives(rig, nodes={"x1": 1, "x2": 2, "phi": 9})
    with Electronics(rig, Path()), pytest.raises(DriverError, match=r"drive phi \(node 9\)"):
        open_devices(Context(other, 1 / RATE_HZ, Path()))


@pytest.mark.parametrize("every", [2, 4, 5])
def test_slower_drives_follow_between_their_syncs(rig: RigConfig, every: int) -> None:
    slow = with_drives(rig, every=every)
    with Electronics(slow, Path()) as electronics:
        devices = open_devices(Context(slow, 1 / RATE_HZ, Path()))
        drives: Any = devices.drives
        beam, rotor, gap, coil = np.zeros(3), np.zeros(3), np.zeros(9), np.zeros(9)
        speed, cycles = 0.02, 60
        for k in range(cycles):
            for sync in devices.syncs:
                sync(k)
            devices.sensors.read(gap)
            # In real time the answers have four periods; here the host would not wait for them.
            while drives._waiting:
                assert drives._link.receive(time.perf_counter() + 10.0)
            devices.drives.read(beam, rotor)
            devices.amplifiers.read(coil)
            devices.amplifiers.write(np.zeros(9))
            moved = speed * k / RATE_HZ
            devices.drives.write(np.array([moved, speed, 0.0]), np.zeros(3))
        true = electronics.core.plant.beam.copy()
        devices.close()
    # The setpoint written in cycle k - 2 is of this moment; at constant speed, the drive is there.
    assert true[0] == pytest.approx(speed * (cycles - 3) / RATE_HZ, abs=2e-8)
    assert beam[0] == pytest.approx(true[0], abs=1e-6)
    assert beam[1] == pytest.approx(speed, rel=1e-4)


def nodes_on(electronics: Electronics) -> Any:
    """Return the emulated nodes of the drives."""
    emulators: Any = electronics.emulators
    return next(emulator.drives for emulator in emulators if emulator.drives is not None)


def run_to(devices: Devices, electronics: Electronics, cycles: range) -> None:
    """Run cycles at rest; wait after each until its targets have arrived."""
    nodes = nodes_on(electronics)
    for k in cycles:
        run(devices, range(k, k + 1))
        wait_until(lambda: all(drive.has_rpdo for drive in nodes.drives))


def test_drive_with_empty_pdo_mapping_exchanges_none(
    rig: RigConfig, monkeypatch: pytest.MonkeyPatch, patience
) -> None:
    """The mapping in the EDS may be a default; only what the host has mapped counts."""
    for mapping in ("RPDO_MAPPING", "TPDO_MAPPING"):
        monkeypatch.setattr(f"levid.drivers.can.canopen_homing_and_enabling.{mapping}", ())
    patience.seconds = 0.5 / RATE_HZ
    with Electronics(rig, Path()) as electronics:
        devices = open_devices(Context(rig, 1 / RATE_HZ, Path()))
        with pytest.raises(StaleError):
            run(devices, range(10))
        assert not any(drive.cyclic for drive in nodes_on(electronics).drives)
        devices.close()


def test_drives_without_targets_stop_in_fault(rig: RigConfig) -> None:
    """The host hangs: after expire_s the drives enter fault by themselves."""
    brief = with_drives(rig, expire_s=0.1)
    with Electronics(brief, Path()) as electronics:
        devices = open_devices(Context(brief, 1 / RATE_HZ, Path()))
        run_to(devices, electronics, range(10))
        core = electronics.core
        for _ in range(round(0.1 * RATE_HZ)):
            core.pass_period()
        assert core.drive_state is DriveState.OPERATING
        core.pass_period()
        wait_until(lambda: core.drive_state is DriveState.FAULT)
        assert not core.motion[:, 1:].any()
        with pytest.raises(DriveError, match="emergency, error code 0x8250"):
            wait_until(lambda: bool(run_to(devices, electronics, range(10, 11))))
        devices.recover()
        run_to(devices, electronics, range(11, 20))
        assert core.drive_state is DriveState.OPERATING
        devices.close()


def test_close_switches_the_drives_off(rig: RigConfig) -> None:
    with Electronics(rig, Path()) as electronics:
        devices = open_devices(Context(rig, 1 / RATE_HZ, Path()))
        run_to(devices, electronics, range(5))
        assert electronics.core.drive_state is DriveState.OPERATING
        devices.close()
        wait_until(lambda: electronics.core.drive_state is DriveState.OFF)


def test_release_does_not_advance_the_plant(rig: RigConfig) -> None:
    """An extra SYNC would count further cycles, in which the force acts."""
    slow = with_drives(rig, every=4)
    with Electronics(slow, Path()) as electronics:
        devices = open_devices(Context(slow, 1 / RATE_HZ, Path()))
        run(devices, range(6))
        wait_until(lambda: electronics.core.cycle == 5)
        devices.drives.release()
        wait_until(lambda: electronics.core.drive_state is DriveState.OFF)
        run(devices, range(6, 7))  # by then all frames have been handled
        wait_until(lambda: electronics.core.cycle >= 6)
        assert electronics.core.cycle == 6
        devices.close()


def test_drives_without_sync_counter_get_empty_syncs(rig: RigConfig, tmp_path: Path) -> None:
    """A drive without object 0x1019 rejects a SYNC with data."""
    text = shipped("drive.eds").read_text()
    (tmp_path / "plain.eds").write_text(
        text.replace("22=0x1019", "22=0x1002").replace("[1019]", "[1002]"),
    )
    plain = with_drives(rig, eds=str(tmp_path / "plain.eds"))
    with Electronics(plain, Path()) as electronics:
        devices = open_devices(Context(plain, 1 / RATE_HZ, Path()))
        run_to(devices, electronics, range(20))
        assert electronics.core.drive_state is DriveState.OPERATING
        devices.close()


PDO = """
[{index}]
ParameterName=another PDO
ObjectType=0x9
SubNumber=2

[{index}sub0]
ParameterName=Highest sub-index supported
ObjectType=0x7
DataType=0x0005
AccessType=ro
DefaultValue=1
PDOMapping=0

[{index}sub1]
ParameterName=COB-ID
ObjectType=0x7
DataType=0x0007
AccessType=rw
DefaultValue=$NODEID+{cob_id}
PDOMapping=0

[{mapping}]
ParameterName=its mapping
ObjectType=0x9
SubNumber=1

[{mapping}sub0]
ParameterName=Number of mapped objects
ObjectType=0x7
DataType=0x0005
AccessType=rw
DefaultValue=0
PDOMapping=0
"""


def test_other_pdos_of_a_drive_are_switched_off(rig: RigConfig, tmp_path: Path) -> None:
    """Drives are delivered with valid event-driven TPDOs, for which the bus has no room."""
    others = {0x1401: 0x300, 0x1403: 0x500, 0x1801: 0x280, 0x1803: 0x8000_0480}
    text = shipped("drive.eds").read_text()
    for index, cob_id in others.items():
        hexadecimal = {"index": index, "mapping": index + 0x200}
        names = {name: f"{number:04X}" for name, number in hexadecimal.items()}
        text += PDO.format(cob_id=f"0x{cob_id:X}", **names)
    (tmp_path / "more.eds").write_text(text)
    more = with_drives(rig, eds=str(tmp_path / "more.eds"))
    with Electronics(more, Path()) as electronics:
        nodes = nodes_on(electronics)
        found = lambda drive, index: drive.node.sdo[index][1].raw  # noqa: E731
        valid = [index for index in others if not found(nodes.drives[0], index) >> 31]
        assert valid == [0x1401, 0x1403, 0x1801]  # at power-on
        devices = open_devices(Context(more, 1 / RATE_HZ, Path()))
        for drive in nodes.drives:
            for index, cob_id in others.items():
                assert found(drive, index) == cob_id + drive.node_id | 1 << 31
        run_to(devices, electronics, range(5))  # the mapped PDOs are exchanged
        devices.close()


def test_expiry_shorter_than_two_syncs_is_refused(rig: RigConfig) -> None:
    with pytest.raises(ConfigError, match=r"drives.expire_s: expected at least 0.08.*found 0.05"):
        check_backends(Context(with_drives(rig, every=4, expire_s=0.05), 1 / RATE_HZ, Path()))


def test_invalid_eds_is_refused_before_anything_is_opened(rig: RigConfig, tmp_path: Path) -> None:
    for eds in ("nowhere.eds", "text.eds"):
        (tmp_path / "text.eds").write_text("no such thing")
        context = Context(with_drives(rig, eds=eds), 1 / RATE_HZ, tmp_path)
        with pytest.raises(ConfigError, match=f"{eds}: not a valid EDS"):
            check_backends(context)


def test_duplicate_ids_are_refused_before_anything_is_opened(
    rig: RigConfig, tmp_path: Path
) -> None:
    twice = with_drives(rig, nodes={"x1": 1, "x2": 1, "phi": 3})
    words = r"can.main: expected a different ID .* 0x081 for emergency of x1 \(node 1\)"
    with pytest.raises(ConfigError, match=words):
        check_backends(Context(twice, 1 / RATE_HZ, Path()))
    text = shipped("levid.dbc").read_text()
    for old, new in (("BO_ 40", "BO_ 386"), ("VAL_ 40", "VAL_ 386")):
        text = text.replace(f"{old} ", f"{new} ")
    (tmp_path / "taken.dbc").write_text(text)
    bus = rig.can["main"].model_copy(update={"dbc": str(tmp_path / "taken.dbc")})
    taken = rig.model_copy(update={"can": {"main": bus}})
    with pytest.raises(ConfigError, match="found 0x182 for Gaps0 and TPDO 1 of x2"):
        check_backends(Context(taken, 1 / RATE_HZ, Path()))


def test_stamps_of_the_interface_are_converted_to_the_loops_clock() -> None:
    before = time.perf_counter()
    stamps = iter([time.time() - 0.25, 0.0])
    bus: Any = SimpleNamespace(receive=lambda _: ReceivedFrame(0x7F0, b"", next(stamps)))
    link = CanLink("main", load().can["main"], bus)
    link.receive(0.0)  # the kernel received it a quarter of a second ago
    # The clocks are read one after the other; the process may be put to sleep in between.
    slept_s = time.perf_counter() - before
    assert link.received_s == pytest.approx(before - 0.25, abs=slept_s + 1e-3)
    link.receive(0.0)  # without a timestamp
    assert link.received_s >= before
