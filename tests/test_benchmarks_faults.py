"""The fault benchmark judges by what a trial itself left: recordings, logs, forces, names."""

from __future__ import annotations

import mmap
import subprocess
from pathlib import Path
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest
from from_benchmarks import module, script

from levid.log.writer import LogWriter


@pytest.fixture(scope="module")
def faults() -> ModuleType:
    return script("faults")


def log(path: Path, name: str = "", rows: int = 10) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    data = np.zeros(rows, [("cycle", "<u8")])
    with LogWriter(
        path, data.dtype, rate_hz=1e3, metadata={"name": name}, attachments={}
    ) as writer:
        writer.write(data, np.arange(rows, dtype=np.uint64))
    return path


def without_a_row(path: Path) -> Path:
    """As a recorder leaves it that was killed before its first chunk."""
    path.parent.mkdir(parents=True, exist_ok=True)
    dtype = np.dtype([("cycle", "<u8")])
    with LogWriter(path, dtype, rate_hz=1e3, metadata={}, attachments={}):
        head = path.read_bytes()
    path.write_bytes(head)
    return path


def test_recording_of_an_earlier_fault_names_nothing(faults: ModuleType, tmp_path: Path) -> None:
    old = log(tmp_path / "fault-1-SUPERVISOR.mcap", "SUPERVISOR")

    def recordings() -> set[Path]:
        return set(tmp_path.glob("*.mcap"))

    assert faults.recorded_name(recordings, {old}, 0.2) == "nothing"
    without_a_row(tmp_path / "fault-2-LOOP.mcap")
    assert faults.recorded_name(recordings, {old}, 0.2) == "nothing"
    log(tmp_path / "fault-3-LOOP.mcap", "LOOP")
    assert faults.recorded_name(recordings, {old}, 0.2) == "LOOP"


def test_log_without_a_row_is_unreadable_but_of_a_killed_recorder(
    faults: ModuleType, tmp_path: Path
) -> None:
    log(tmp_path / "flight-1" / "a.mcap")
    killed = without_a_row(tmp_path / "flight-2" / "a.mcap").parent.name
    assert faults.unreadable(tmp_path, {killed}) == 0
    assert faults.unreadable(tmp_path, set()) == 1
    without_a_row(tmp_path / "faults" / "fault-1-LOOP.mcap")
    assert faults.unreadable(tmp_path, {killed}) == 1


def test_all_flight_recordings_are_kept_until_they_are_read(
    faults: ModuleType, tmp_path: Path
) -> None:
    for bus in ("canfd", "serial"):
        kept = faults._fault_rig.rig_of(bus, tmp_path)["recording"]["keep_faults"]
        assert kept >= 1000  # one a trial, and no bus sees more of them


def test_memory_pressure_leaves_the_machine_some_and_quickly_takes_little() -> None:
    hog = module("_memory_hog")
    assert hog.to_take(20 << 30) == int(0.9 * (20 << 30)) - (1 << 30)
    assert hog.to_take(20 << 30, 1 << 30) == 1 << 30
    assert hog.to_take(1 << 30) == 0
    assert 0 < hog.available() < 1 << 50


def test_memory_is_held_for_real(monkeypatch) -> None:
    hog = module("_memory_hog")

    def resident() -> int:
        return int(Path("/proc/self/statm").read_text().split()[1]) * mmap.PAGESIZE

    before = resident()
    blocks = hog.hold(100 << 20)
    assert sum(len(block) for block in blocks) >= 100 << 20
    assert resident() - before > 90 << 20
    monkeypatch.setattr(hog, "available", lambda: hog.SAFETY)
    assert not hog.hold(100 << 20)


def test_full_disk_is_one_without_a_byte_left(faults: ModuleType, tmp_path: Path) -> None:
    small = module("_fault_rig").small_disk(tmp_path / "small")
    if small is None:
        pytest.skip("no right to mount")
    try:
        rig = SimpleNamespace(
            small=small, folder=tmp_path, flight=small / "flight-1",
            may_be_cut=lambda: None, until=lambda _: None,
        )  # fmt: skip
        log(rig.flight / "a.mcap")
        told = module("_fault_list")._full_disk(rig, {})
        with pytest.raises(OSError, match="No space left on device") as full:
            (small / "more").write_bytes(b"x" * 10_000)
        assert told({"recording": str(full.value)})
        assert not told({"recording": "File too large"})
        module("_fault_list").make_room(rig)
        assert faults.unreadable(tmp_path, set()) == 0
        (small / "more").write_bytes(b"x" * 10_000)
        assert (tmp_path / "flight-1" / "a.mcap").exists()
    finally:
        subprocess.run(["umount", "--lazy", str(small)], check=True)


def trial(faults: ModuleType, fault: str, **came: object) -> object:
    return faults.Trial("serial", 0, fault, usable=True, **came)


def by_key(figures) -> dict[str, float]:
    return {figure.key: figure.value for figure in figures}


def test_times_are_told_apart_and_what_has_no_promise_is_in_none(faults: ModuleType) -> None:
    trials = [
        trial(faults, "trip 3", cycles=3, named=True),
        trial(faults, "trip 3", cycles=4, named=True),
        trial(faults, "drop", cycles=28, named=True),
        trial(faults, "drop", cycles=29, named=True),
        trial(faults, "push 60", cycles=1, named=True),
        trial(faults, "frozen 7", cycles=100, named=True),
    ]
    found = by_key(faults.figures(trials, []))
    assert (found["within_3"], found["within_own_timeout"]) == (1 / 4, 2 / 4)
    assert (found["shows_late"], found["slowest_stop"], found["stopped"]) == (2, 29, 1.0)


def test_trial_that_failed_counts_against_what_was_asked(faults: ModuleType) -> None:
    trials = [
        trial(faults, "trip 3", cycles=1, named=True),
        trial(faults, "trip 3", failed="DaemonError"),
        trial(faults, "disk full", undisturbed=True, told=True),
        trial(faults, "disk full", failed="RuntimeError"),
        faults.Trial("serial", 0, "stop", wrong=["does not fly"]),
        trial(faults, ""),
    ]
    found = by_key(faults.figures(trials, [faults.Logs(9, 1), faults.Logs(3, 0)]))
    assert (found["faults"], found["failed"], found["usable"]) == (4, 2, 5 / 6)
    assert found["stopped"] == found["named"] == found["within_3"] == found["undisturbed"] == 0.5
    assert (found["logs"], found["unreadable"]) == (12, 1)


class Rig:
    """Answers as a rig of whatever a test wants of it."""

    small, bus, cut, started = None, "serial", frozenset(), 0

    def __init__(self, _bus: str, folder: Path, _quick: bool) -> None:
        self.folder, self.periods = folder, [10, 12, 12]
        self.path, self.daemon = folder, SimpleNamespace(poll=lambda: None)
        type(self).started += 1

    def lift_off(self, _: Path) -> dict[str, object]:
        return {}

    def until(self, condition) -> dict[str, object] | None:
        status = {"state": "LEVITATING", "fault": "AMPLIFIER", "cycle": 0}
        return status if condition(status) else None

    def forces(self) -> bool:
        return len(self.periods) == 3

    def forced_periods(self, *_: str) -> int:
        return self.periods.pop(0) if len(self.periods) > 1 else self.periods[0]

    def recordings(self) -> set[Path]:
        return set()

    def close(self) -> None: ...


def test_force_that_comes_back_is_seen(faults: ModuleType, tmp_path: Path) -> None:
    for last, back in ((12, 0), (15, 3)):
        rig, one = Rig("serial", tmp_path, True), faults.Trial("serial", 0, "trip 3")
        rig.periods = [10, 12, last]
        faults._try(rig, one)
        assert (one.cycles, one.came_back, one.named) == (2, back, True)
        assert by_key(faults.figures([one], []))["came_back"] == bool(back)


def test_run_goes_on_behind_a_trial_that_fails_and_where_it_stopped(
    faults: ModuleType, tmp_path: Path, monkeypatch
) -> None:
    tried: list[int] = []

    def attempt(_: Rig, one) -> None:
        tried.append(one.number)
        if one.number == 3 and len(tried) == 4:
            raise faults.DaemonError("expected an answer")
        if one.number == 7 and tried.count(7) == 1:
            raise KeyboardInterrupt
        one.usable = True

    monkeypatch.setattr(faults, "KEPT", tmp_path)
    monkeypatch.setattr(faults, "Rig", Rig)
    monkeypatch.setattr(faults, "_try", attempt)
    Rig.started = 0
    with pytest.raises(KeyboardInterrupt):
        faults.measure(True)
    found = by_key(faults.measure(True))
    assert tried == [*range(8), *range(7, 21), *range(21)]  # both buses, each with a last lift-off
    assert Rig.started == 4  # the first, one behind the trial that failed, one again, one a bus
    assert (found["failed"], found["usable"]) == (1, 41 / 42)
    before = len(tried)
    faults.measure(True)  # a whole run is not carried on
    assert len(tried) == before + 42
