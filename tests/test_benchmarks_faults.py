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
        kept = faults._rig(bus, tmp_path)["recording"]["keep_faults"]
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
    small = faults._small_disk(tmp_path / "small")
    if small is None:
        pytest.skip("no right to mount")
    try:
        rig = SimpleNamespace(
            small=small, folder=tmp_path, flight=small / "flight-1",
            may_be_cut=lambda: None, until=lambda _: None,
        )  # fmt: skip
        log(rig.flight / "a.mcap")
        told = faults._full_disk(rig, {})
        with pytest.raises(OSError, match="No space left on device") as full:
            (small / "more").write_bytes(b"x" * 10_000)
        assert told({"recording": str(full.value)})
        assert not told({"recording": "File too large"})
        faults._make_room(rig)
        assert faults.unreadable(tmp_path, set()) == 0
        (small / "more").write_bytes(b"x" * 10_000)
        assert (tmp_path / "flight-1" / "a.mcap").exists()
    finally:
        subprocess.run(["umount", "--lazy", str(small)], check=True)
