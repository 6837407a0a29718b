"""Drives between cycles: homing, switching off after a failure, SYNC with or without counter."""

from __future__ import annotations

import re
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from drives_at_rest_cycles import run, with_drives
from waiting import wait_until

from levid.config.rig import RigConfig
from levid.config.shipped import shipped
from levid.drivers.base import Context, Devices, DriveError, DriverError
from levid.drivers.can.canopen_homing_and_enabling import DriveNode, interpolation
from levid.drivers.open_backends import open_devices
from levid.sim.electronics.drive_nodes import Drive
from levid.sim.electronics.emulated_rig import Electronics
from levid.wire.can.cia402 import (
    HOMING_ATTAINED,
    HOMING_ERROR,
    POSITION_M,
    POSITION_RAD,
    TARGET_REACHED,
    TPDO,
    DriveStates,
    Mode,
    Object,
)

RATE_HZ = 100.0
OPERATING = DriveStates.OPERATION_ENABLED


pytestmark = pytest.mark.usefixtures("host_paced")


@pytest.fixture
def rig(rig_on, quiet_sim: Path) -> RigConfig:
    return rig_on("can", RATE_HZ, quiet_sim)


def opened(rig: RigConfig) -> Devices:
    return open_devices(Context(rig, 1 / RATE_HZ, Path()))


def nodes_of(electronics: Electronics) -> list:
    (emulator,) = electronics.emulators
    return emulator.drives.drives  # type: ignore[attr-defined]


@pytest.fixture
def brief_homing() -> Iterator[pytest.MonkeyPatch]:
    """Give the drives 0.3 s to home; `undo` gives them back their time."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("levid.drivers.can.canopen_drives._HOMING_S", 0.3)
        yield patch


def do_not_home(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let hosts skip the homing."""
    monkeypatch.setattr(DriveNode, "start_homing", lambda _: None)
    monkeypatch.setattr(DriveNode, "homing", lambda _: (True, True))


def off_by(devices: Devices, electronics: Electronics, cycles: range) -> np.ndarray:
    """Return the error of the beam and rotor positions that the host reads."""
    beam, rotor = np.zeros(3), np.zeros(3)
    for k in cycles:  # without targets
        for sync in devices.syncs:
            sync(k)
        devices.drives.read(beam, rotor)
    true = electronics.core.axes
    return np.array([beam[0] - 0.5 * (true[0, 0] + true[1, 0]), rotor[0] - true[2, 0]])


def test_positions_are_right_once_drives_are_homed(rig: RigConfig) -> None:
    """Until then each drive counts from an arbitrary origin."""
    with Electronics(rig, Path()) as electronics:
        drives = nodes_of(electronics)
        for drive, (position, _, force) in zip(drives, electronics.core.axes, strict=True):
            drive.update_readings(position, force)
        counts = [TPDO.unpack(drive.tpdo()[1])[1] for drive in drives]
        positions = electronics.core.axes[:, 0]
        wrong_m = [POSITION_M * counts[i] - positions[i] for i in (0, 1)]
        assert min(map(abs, wrong_m)) > 1e-3
        assert max(map(abs, wrong_m)) < rig.limits.beam_m  # within its travel
        assert abs(wrong_m[0] - wrong_m[1]) > 1e-3
        assert abs(POSITION_RAD * counts[2] - positions[2]) > 0.1
        devices = opened(rig)
        np.testing.assert_allclose(off_by(devices, electronics, range(3)), 0.0, atol=2e-7)
        devices.close()


def test_drives_that_were_not_homed_are_skewed(
    rig: RigConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    do_not_home(monkeypatch)
    with Electronics(rig, Path()):
        devices = opened(rig)
        with pytest.raises(DriveError, match=r"X1 and X2 .* found 50\.000 mm"):
            run(devices, range(3))
        devices.close()


def test_drive_with_lost_encoder_is_homed_again(
    rig: RigConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    with Electronics(rig, Path()) as electronics:
        devices = opened(rig)
        run(devices, range(3))
        electronics.injector.command("encoder phi")
        with pytest.raises(DriveError, match="0x7305"):
            run(devices, range(3, 10))
        electronics.injector.clear()
        with monkeypatch.context() as patch:
            do_not_home(patch)
            devices.recover()
            assert abs(off_by(devices, electronics, range(10, 13))[1]) > 0.1
        devices.recover()
        np.testing.assert_allclose(off_by(devices, electronics, range(13, 16)), 0.0, atol=2e-7)
        devices.close()


def test_failed_start_leaves_no_drive_powered_and_the_next_homes_again(
    rig: RigConfig, brief_homing: pytest.MonkeyPatch
) -> None:
    """A pre-operational node ignores PDOs; homing starts with an edge, every time."""
    with Electronics(rig, Path()) as electronics:
        drives = nodes_of(electronics)
        in_time_s, drives[1].homing_s = drives[1].homing_s, 1e9
        with pytest.raises(DriveError, match=r"drive x2 \(node 2\).*: not homed after 0.3 s by"):
            opened(rig)
        wait_until(lambda: all(drive.state is not OPERATING for drive in drives))
        drives[1].homing_s = in_time_s
        brief_homing.undo()
        devices = opened(rig)
        assert all(drive.operating for drive in drives)
        devices.close()


@pytest.mark.usefixtures("brief_homing")
def test_failed_recovery_leaves_no_drive_powered(rig: RigConfig) -> None:
    with Electronics(rig, Path()) as electronics:
        devices, drives = opened(rig), nodes_of(electronics)
        run(devices, range(5))
        drives[2].homing_s = 1e9  # X1 and X2 are homed again by then
        with pytest.raises(DriveError, match="drive phi"):
            devices.recover()
        wait_until(lambda: all(drive.state is not OPERATING for drive in drives))
        devices.close()


def test_drives_beside_one_in_fault_are_stopped(rig: RigConfig) -> None:
    with Electronics(rig, Path()) as electronics:
        devices, drives = opened(rig), nodes_of(electronics)
        run(devices, range(5))
        electronics.injector.command("encoder x2")
        with pytest.raises(DriveError, match="x2"):
            run(devices, range(5, 20))
        run(devices, range(20, 25))
        wait_until(lambda: all(drive.state is not OPERATING for drive in drives))
        electronics.injector.clear()
        devices.recover()
        run(devices, range(25, 30))
        assert all(drive.operating for drive in drives)
        devices.close()


def test_motors_of_the_gantry_start_together(
    rig: RigConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    done: list[tuple[str, str]] = []
    for name in ("start_homing", "homing"):
        real = getattr(DriveNode, name)

        def noted(node: DriveNode, name=name, real=real) -> object:
            done.append((name, node.name))
            return real(node)

        monkeypatch.setattr(DriveNode, name, noted)
    with Electronics(rig, Path()):
        opened(rig).close()
    assert done[:4] == [(do, x) for do in ("start_homing", "homing") for x in ("x1", "x2")]
    started = done.index(("start_homing", "phi"))
    assert {name for do, name in done[started:]} == {"phi"}


def test_gantry_that_skews_during_homing_is_stopped(
    rig: RigConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    real, asked = DriveNode.homing, []

    with Electronics(rig, Path()) as electronics:
        core, drives = electronics.core, nodes_of(electronics)
        for drive in drives:
            drive.homing_s = 1e9

        def homing(node: DriveNode) -> tuple[bool, bool]:
            asked.append(node)
            with core.lock:
                core.axes[0, 0] = 3e-3  # any position at the begin
                core.axes[1, 0] = 2e-3 if len(asked) < 8 else 1.5e-3
            return real(node)

        monkeypatch.setattr(DriveNode, "homing", homing)
        with pytest.raises(DriveError, match=r"X1 and X2 .* found 0\.500 mm"):
            opened(rig)
        wait_until(lambda: all(drive.state is not OPERATING for drive in drives))


@pytest.mark.usefixtures("brief_homing")
def test_homing_is_done_once_the_target_is_reached(
    rig: RigConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With bit 12 (homing attained) alone the drive is still moving."""
    monkeypatch.setattr("levid.sim.electronics.drive_nodes.TARGET_REACHED", 0)
    with Electronics(rig, Path()), pytest.raises(DriveError, match=r"drive x1.*not homed"):
        opened(rig)


@pytest.mark.parametrize("before", [TARGET_REACHED | HOMING_ATTAINED, HOMING_ERROR])
def test_result_of_the_previous_homing_is_ignored(
    rig: RigConfig, monkeypatch: pytest.MonkeyPatch, before: int
) -> None:
    """The statusword shows the result of the last homing for a moment after the next has begun."""
    real, follow, at_home = Drive.statusword.fget, DriveNode.follow, []
    begun_s: dict[int, float] = {}
    assert real is not None

    def lagging(drive: Drive) -> int:
        word = int(real(drive))
        homing = drive.mode == Mode.HOMING and not word & TARGET_REACHED
        if homing and drive.state is OPERATING:
            began_s = begun_s.setdefault(drive.node_id, time.monotonic())
            # Half as long as the host ignores a result.
            return word | (before if time.monotonic() - began_s < 0.05 else 0)
        return word

    monkeypatch.setattr(Drive, "statusword", property(lagging))
    with Electronics(rig, Path()) as electronics:
        drives = {drive.node_id: drive for drive in nodes_of(electronics)}
        for drive in drives.values():
            drive.homing_s = 0.2  # twice as long

        def noted(node: DriveNode) -> None:
            at_home.append(bool(real(drives[node.node_id]) & HOMING_ATTAINED))
            follow(node)

        monkeypatch.setattr(DriveNode, "follow", noted)
        opened(rig).close()
    assert at_home == [True] * 3


def test_drive_that_is_home_at_once_is_accepted(
    rig: RigConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With methods 35 and 37 home is the present position: bit 12 may never be low."""
    real = Drive.statusword.fget
    assert real is not None
    word = property(lambda drive: int(real(drive)) | TARGET_REACHED | HOMING_ATTAINED)
    monkeypatch.setattr(Drive, "statusword", word)
    with Electronics(rig, Path()):
        opened(rig).close()


def test_forces_are_per_mille_of_the_rated_force(
    rig: RigConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    acting, update = (0.25, 0.25, 2.5e-3), Drive.update_readings
    monkeypatch.setattr(
        Drive, "update_readings", lambda drive, at, _: update(drive, at, acting[drive.axis])
    )
    beam, rotor = np.zeros(3), np.zeros(3)
    with Electronics(rig, Path()) as electronics:
        devices = opened(rig)
        for sync in devices.syncs:
            sync(0)
        devices.drives.read(beam, rotor)
        sent = [TPDO.unpack(drive.tpdo()[1])[2] for drive in nodes_of(electronics)]
        devices.close()
    assert sent == [250] * 3
    np.testing.assert_allclose([beam[2], rotor[2]], [0.5, 2.5e-3], rtol=1e-12)


SECTION = re.compile(r"(\[1019\].*?AccessType=)rw(\nDefaultValue=)240", re.DOTALL)


def with_overflow(rig: RigConfig, folder: Path, overflow: int) -> RigConfig:
    """Return the rig with drives whose object 0x1019 is read-only."""
    text, found = SECTION.subn(rf"\g<1>ro\g<2>{overflow}", shipped("drive.eds").read_text())
    assert found == 1
    (folder / "other.eds").write_text(text)
    return with_drives(rig, eds=str(folder / "other.eds"))


@pytest.mark.parametrize("overflow", [0, 240])
def test_sync_is_counted_if_the_drives_require_it(
    rig: RigConfig, tmp_path: Path, overflow: int
) -> None:
    other = with_overflow(rig, tmp_path, overflow)
    with Electronics(other, Path()) as electronics:
        devices = opened(other)
        run(devices, range(5))  # a SYNC of the other kind would not be answered
        assert all(drive.operating for drive in nodes_of(electronics))
        devices.close()


def test_other_sync_overflow_is_refused(rig: RigConfig, tmp_path: Path) -> None:
    other = with_overflow(rig, tmp_path, 10)
    words = r"0x1019\): expected 240, or 0 for a SYNC without counter, found 10"
    with Electronics(other, Path()), pytest.raises(DriverError, match=words):
        opened(other)


def test_sync_counted_by_some_drives_only_is_refused(rig: RigConfig) -> None:
    with Electronics(rig, Path()) as electronics:
        nodes_of(electronics)[1].node.set_data(Object.SYNC_OVERFLOW, 0, b"\0")
        with pytest.raises(DriverError, match="only in x1, phi"):
            opened(rig)


@pytest.mark.parametrize(
    ("sync_s", "expected"),
    [(1e-3, (1, -3)), (4e-3, (4, -3)), (1 / 3000, (33, -5)), (1e-4, (1, -4)), (2.5e-4, (25, -5))],
)
def test_interpolation_period_is_the_nearest(sync_s: float, expected: tuple[int, int]) -> None:
    assert interpolation(sync_s) == expected


def test_homing_starts_again_after_a_host_that_left_during_homing(rig: RigConfig) -> None:
    """The drive is enabled, and the bit that starts homing is set already."""
    with Electronics(rig, Path()) as electronics:
        for drive in nodes_of(electronics):
            drive.state, drive.mode = OPERATING, Mode.HOMING
            drive.store_rpdo(0x1F, 0)
            drive.apply_rpdo()
        opened(rig).close()


def test_fault_that_returns_after_the_first_reset_is_reset_again(
    rig: RigConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    real, returned = Drive.statusword.fget, []
    assert real is not None

    def returning(drive: Drive) -> int:
        if drive.axis == 2 and drive.state is not DriveStates.FAULT and not returned:
            returned.append(drive.axis)
            drive.fail(0x7305, 1)
        return int(real(drive))

    with Electronics(rig, Path()) as electronics:
        nodes_of(electronics)[2].fail(0x7305, 1)
        monkeypatch.setattr(Drive, "statusword", property(returning))
        opened(rig).close()
    assert returned


def test_drive_failure_during_homing_names_its_error_code(
    rig: RigConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    """At once, not at the time limit of homing."""
    with Electronics(rig, Path()) as electronics:
        drives = nodes_of(electronics)
        drives[2].homing_s = 1e9
        begun = DriveNode.start_homing

        def start(node: DriveNode) -> None:
            begun(node)
            if node.name == "phi":
                drives[2].fail(0x7305, 1)

        monkeypatch.setattr(DriveNode, "start_homing", start)
        began_s = time.monotonic()
        with pytest.raises(DriveError, match="error code 0x7305"):
            opened(rig)
        assert time.monotonic() - began_s < 5.0
