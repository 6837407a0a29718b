"""What the fault benchmark finds in logs, recordings and on disks, and what it holds and counts."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
import time
from collections.abc import Sequence
from pathlib import Path
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest
import yaml

from levid.benchmarks.daemon import (
    fault_actions,
    fault_electronics,
    fault_list,
    fault_logs,
    fault_rig,
)
from levid.benchmarks.harness import memory_pressure
from levid.config.rig import load_rig
from levid.daemon.control.faults import Fault
from levid.daemon.control.states import State
from levid.log.writer import LogWriter
from levid.sim.electronics.rig import Electronics
from levid.wire.device_protocol import AmplifierState

DTYPE = np.dtype([("cycle", "<u8"), ("state", "u1"), ("fault", "u1"), ("skipped", "u1")])


@pytest.fixture(scope="module")
def logs() -> ModuleType:
    return fault_logs


def log(
    path: Path, cycles: Sequence[int], name: str = "", fault: Fault = Fault.NONE, since: int = 0
) -> Path:
    """Write a log of these cycles in flight, with the fault from the cycle `since` on."""
    path.parent.mkdir(parents=True, exist_ok=True)
    data = np.zeros(len(cycles), DTYPE)
    data["cycle"] = cycles
    data["state"] = State.LEVITATING
    data["fault"][data["cycle"] >= since] = fault
    with LogWriter(
        path, data.dtype, rate_hz=50.0, metadata={"name": name}, attachments={}
    ) as writer:
        writer.write(data, data["cycle"])
    return path


def cut(path: Path, share: float = 0.5) -> Path:
    data = path.read_bytes()
    path.write_bytes(data[: round(share * len(data))])
    return path


def without_end(path: Path) -> Path:
    """Cut a log behind its last chunk, as a recorder leaves it that was killed."""
    data = path.read_bytes()
    path.write_bytes(data[: len(data) - 30])
    return path


def test_logs_of_a_flight_are_whole_and_reach_its_end(logs: ModuleType, tmp_path: Path) -> None:
    expected = logs.Expected(began=95, until=300, rate_hz=50.0)
    path = log(tmp_path / "a.mcap", range(100, 300))
    assert logs.look_at_logs([path], expected).wrong == []
    assert "no log" in logs.look_at_logs([], expected).wrong[0]
    short = logs.look_at_logs([log(tmp_path / "b.mcap", range(100, 200))], expected)
    assert (short.tail_s, len(short.wrong)) == (pytest.approx(101 / 50), 1)
    open_end = logs.look_at_logs([without_end(path)], expected)
    assert (open_end.incomplete, open_end.unreadable) == (1, 0)
    broken = logs.look_at_logs([cut(path, 0.1)], expected)
    assert (broken.unreadable, broken.rows) == (1, 0)
    path.write_bytes(b"no log")
    assert logs.look_at_logs([path], expected).unreadable == 1


def test_rows_that_no_part_has_are_missing_but_those_that_were_skipped(
    logs: ModuleType, tmp_path: Path
) -> None:
    expected = logs.Expected(began=95, until=199, rate_hz=50.0, parted=True)
    first = without_end(log(tmp_path / "flight.mcap", range(100, 150)))
    os.utime(first, (1, 1))
    second = log(tmp_path / "flight.2.mcap", range(140, 200))  # what was written twice is there
    look = logs.look_at_logs([second, first], expected)
    assert (look.missing, look.incomplete, look.rows, look.wrong) == (0, 0, 100, [])
    second = log(tmp_path / "other.mcap", range(155, 200))
    assert logs.look_at_logs([first, second], expected).missing == 5
    without_end(second)  # which is the newest
    assert logs.look_at_logs([first, second], expected).incomplete == 1


def test_log_on_a_full_disk_lacks_a_second_at_most(logs: ModuleType, tmp_path: Path) -> None:
    path = without_end(log(tmp_path / "flight.mcap", range(100, 150)))
    for cut_at, wrong in ((190, 0), (210, 1)):
        expected = logs.Expected(began=95, until=cut_at, rate_hz=50.0, cut=True)
        assert len(logs.look_at_logs([path], expected).wrong) == wrong
    cut(path, 0.05)  # before its first chunk
    for cut_at, wrong in ((140, 0), (150, 1)):
        expected = logs.Expected(began=95, until=cut_at, rate_hz=50.0, cut=True)
        look = logs.look_at_logs([path], expected)
        assert (look.rowless, look.unreadable, len(look.wrong)) == (1, 0, wrong)


def test_recording_is_new_whole_and_begins_with_the_fault(logs: ModuleType, tmp_path: Path) -> None:
    def recordings() -> set[Path]:
        return set(tmp_path.glob("*.mcap"))

    old = log(tmp_path / "fault-1-DRIVE.mcap", range(100), "DRIVE", Fault.DRIVE, 50)
    assert logs.recording_of(recordings, {old}, 150, 0.1, 1.0).path is None
    new = log(tmp_path / "fault-2-STALE.mcap", range(200), "STALE", Fault.STALE, 160)
    found = logs.recording_of(recordings, {old}, 150, 0.1, 1.0)
    assert (found.path, found.name, found.wrong) == (new, "STALE", ())
    assert "10 cycles before" in logs.recording_of(recordings, {old}, 170, 0.1, 1.0).wrong[0]
    whole = new.read_bytes()
    without_end(new)
    assert "not complete" in logs.recording_of(recordings, {old}, 150, 0.1, 1.0).wrong[0]
    new.write_bytes(whole)
    log(tmp_path / "fault-3-LINK.mcap", range(200), "LINK", Fault.DRIVE, 160)
    found = logs.recording_of(recordings, {old, new}, 150, 0.1, 1.0)
    assert found.wrong == ("the recording of LINK has rows of DRIVE",)
    assert "2 flight" in logs.recording_of(recordings, {old}, 150, 0.1, 1.0).wrong[0]


def test_loop_that_died_has_no_row_of_its_fault_but_those_before(
    logs: ModuleType, tmp_path: Path
) -> None:
    log(tmp_path / "fault-1-LOOP.mcap", range(200), "LOOP")
    for since, wrong in ((200, 0), (205, 1)):
        found = logs.recording_of(lambda: set(tmp_path.glob("*")), set(), since, 0.1, 1.0)
        assert (found.name, len(found.wrong)) == ("LOOP", wrong)


@pytest.mark.parametrize("fault", [Fault.GAP, Fault.LOOP])
def test_recording_that_does_not_look_back_as_far_as_promised_is_wrong(
    logs: ModuleType, tmp_path: Path, fault: Fault
) -> None:
    def wrong(promised_s: float) -> tuple[str, ...]:
        return logs.recording_of(lambda: set(tmp_path.glob("*")), set(), 290, 0.1, promised_s).wrong

    rows = Fault.NONE if fault is Fault.LOOP else fault
    late = log(tmp_path / "fault-1.mcap", range(100, 300), fault.name, rows, 299)
    assert wrong(3.9) == ()  # at 50 Hz
    assert wrong(10.0) == ("the recording looks 3.98 s back, of 10 s",)
    late.unlink()
    log(tmp_path / "fault-1.mcap", range(300), fault.name, rows, 299)
    assert wrong(10.0) == ()  # of a daemon that had just begun


def test_flight_recordings_are_kept_until_they_are_read(tmp_path: Path) -> None:
    for bus in ("canfd", "serial"):
        assert fault_rig.rig_of(bus, tmp_path)["recording"]["keep_faults"] >= 1000


def test_rig_is_one_that_the_daemon_takes(tmp_path: Path) -> None:
    from levid.config.base import parse
    from levid.config.rig import RigConfig

    rig = fault_rig
    for bus in ("canfd", "serial"):
        config = parse(rig.rig_of(bus, tmp_path), RigConfig, bus)
        (on,) = (config.can or config.serial).values()
        assert on.stale_cycles == type(on).model_fields["stale_cycles"].default
    # It is held up for longer than it may, and for less than until setpoints expire.
    assert 2 / rig.RATE_HZ < rig.STALL_S < (rig.EXPIRE_CYCLES - 2) / rig.RATE_HZ


def test_rig_that_does_not_start_leaves_nothing_behind(tmp_path: Path, monkeypatch) -> None:
    rig = fault_rig
    broken = tmp_path / "broken.py"
    broken.write_text("import sys; sys.exit('no bus')")
    monkeypatch.setattr(rig.fault_electronics, "__file__", str(broken))
    with pytest.raises(RuntimeError, match="did not start: no bus"):
        rig.Rig("serial", tmp_path)
    broken.write_text("import time; time.sleep(60)")
    monkeypatch.setattr(rig, "_STARTS_S", 0.3)
    (tmp_path / "small").rmdir()
    with pytest.raises(RuntimeError, match="did not start"):
        rig.Rig("serial", tmp_path)
    assert not (tmp_path / "small").is_mount()


def test_processes_are_waited_for_and_never_for_ever() -> None:
    gone = fault_rig.gone
    with subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE) as process:
        assert not gone([process.pid], 0.1)
        process.kill()
        assert gone([process.pid], 5.0)  # dead, though nobody has looked
    assert gone([], 0.0)


def test_recorder_that_has_the_log_open_is_waited_for(tmp_path: Path) -> None:
    rig = object.__new__(fault_rig.Rig)
    rig.flight, rig.pids, rig.ask = tmp_path / "flight-1", {"recorder": os.getpid()}, lambda _: {}
    rig.flight.mkdir()
    assert rig.logs_are_closed()
    with (rig.flight / "a.mcap").open("w"):
        assert str(rig.flight) in fault_rig._open_files(os.getpid())


def test_full_disk_is_one_without_a_byte_left(tmp_path: Path) -> None:
    small = fault_rig.small_disk(tmp_path / "small")
    if small is None:
        pytest.skip("no right to mount")
    try:
        rig = SimpleNamespace(small=small, ask=lambda _: {"cycle": 7})
        with fault_actions._full_disk(rig, None) as seen:
            with pytest.raises(OSError, match="No space left on device") as full:
                (small / "more").write_bytes(b"x" * 10_000)
            assert seen.cut_at == 7
            assert seen.told({"recording": str(full.value)})
            assert not seen.told({"recording": "File too large"})
        (small / "more").write_bytes(b"x" * 10_000)
    finally:
        subprocess.run(["umount", "--lazy", str(small)], check=True)


def test_what_only_root_can_do_is_left_out_by_others(monkeypatch) -> None:
    deeds = fault_actions
    others = ["disk full", "host's end lost", "memory pressure"]
    for root, without in ((0, ["disk full"]), (1000, others)):
        monkeypatch.setattr(deeds.os, "geteuid", lambda root=root: root)
        monkeypatch.setattr(deeds, "can_press", lambda root=root: root == 0)
        kinds = fault_list.kinds("serial")
        rig = SimpleNamespace(small=None)
        assert sorted(name for name in kinds if deeds.cannot(rig, name)) == without


def test_process_that_says_nothing_is_waited_for_no_longer(tmp_path: Path, monkeypatch) -> None:
    pressure = memory_pressure
    silent = tmp_path / "silent.py"
    silent.write_text("import time; time.sleep(60)")
    monkeypatch.setattr(pressure, "_BEGINS_S", 0.2)
    began_s = time.monotonic()
    with pytest.raises(pressure.NoPressureError, match="says nothing"), pressure._running(silent):
        pass
    assert time.monotonic() - began_s < 10.0


def test_without_a_memory_group_nothing_is_pressed(tmp_path: Path, monkeypatch) -> None:
    pressure = memory_pressure
    monkeypatch.setattr(pressure, "_GROUPS", ())
    assert not pressure.can_press()
    with pytest.raises(pressure.NoPressureError, match="no right"), pressure.pressed((), tmp_path):
        pass


def test_processes_short_of_memory_come_home(tmp_path: Path) -> None:
    pressure = memory_pressure
    with pressure._group() as group:
        if group is None:
            pytest.skip("no right to a memory group")
        with subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE) as one:
            (group / "cgroup.procs").write_text(str(one.pid))
            assert str(one.pid) in (group / "cgroup.procs").read_text().split()
            assert one.stdin is not None
    assert not group.exists()
    file = tmp_path / "file"
    with pressure._on_disk(file):
        assert file.stat().st_size == pressure._FILE_BYTES
    assert not file.exists()


@pytest.fixture
def electronics(tmp_path: Path) -> Electronics:
    file = tmp_path / "rig.yaml"
    file.write_text(yaml.safe_dump(fault_rig.rig_of("serial", tmp_path)))
    return Electronics(load_rig(file), tmp_path)


def test_faults_begin_with_a_cycle_and_are_answered(electronics: Electronics) -> None:
    faulty, core = fault_electronics.Faulty(electronics), electronics.core
    core.begin(1)
    answers: list[dict[str, object]] = []
    lines = ("nan-coil 3", "nan-axis x1", "shift 0.2", "fly away")
    for cycle, line in enumerate(lines, start=2):
        asking = threading.Thread(target=lambda line=line: answers.append(faulty.command(line)))
        asking.start()
        while faulty._due is None:
            time.sleep(0.001)
        core.begin(cycle)
        asking.join(5.0)
    assert [a.get("did") for a in answers] == [*lines[:3], None]
    assert "expected clear or one of" in str(answers[3]["error"])
    assert np.isnan(core.force_n[3])
    assert np.isnan(core.axes[0, 0])
    assert core.axes[1, 0] == pytest.approx(0.2, abs=1e-3)
    assert faulty.command("clear")["did"] == "clear"
    core.begin(9)
    assert np.isfinite(core.axes).all()
    assert np.isfinite(core.force_n).all()


def test_part_of_a_period_with_force_is_one(electronics: Electronics) -> None:
    faulty, core = fault_electronics.Faulty(electronics), electronics.core
    core.amplifier_state = AmplifierState.ENABLED

    def forced() -> int:
        return int(faulty.command("status")["forced_periods"])

    core.begin(1)
    core.setpoints(np.full(9, 5.0))
    core.apply_setpoints()
    assert forced() == 0
    core.begin(2)
    assert forced() == 1
    core.setpoints(np.zeros(9))
    core.apply_setpoints(renews=False)  # in the middle of it
    assert forced() == 2
    core.begin(3)
    assert forced() == 2
