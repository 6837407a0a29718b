"""Test that each fault gets a flight recording, and what a full or failing disk costs."""

from __future__ import annotations

import io
import os
from collections.abc import Callable
from errno import EIO, ENOSPC
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from levid.config.daemon_settings import Recording
from levid.config.files.atomic_write import open_new
from levid.daemon.control.faults import Fault
from levid.daemon.ipc.row_ring import Ring
from levid.daemon.recording.fault_recorder import NO_ROWS, FaultLog
from levid.log.reader import read_log
from levid.log.signals import cycle_dtype

DTYPE = cycle_dtype(9, 9)


def test_clock_set_back_removes_no_new_flight_recording(tmp_path: Path) -> None:
    ring, told = Ring(DTYPE, 4000), []
    for k in range(5):  # of a later year
        (tmp_path / f"fault-20300101T00000{k}.000Z-GAP.mcap").touch()
    log = FaultLog(
        ring, 1e3, tmp_path, Recording(keep_faults=5), {},
        lambda fault, path, error: told.append((fault, Path(path), error)),
    )  # fmt: skip
    ring.rows["cycle"][:2000] = np.arange(2000)
    ring.head = 2000
    for years in (1, 0, 2):  # the clock is set back, then on
        log.epoch_ns = years * 10**16
        log.write(Fault.LINK)
    assert not any(error for _, _, error in told)
    assert all(path.exists() for _, path, _ in told)
    kept = sorted(p.name for p in tmp_path.iterdir())
    assert len(kept) == 5
    assert [name for name in kept if "GAP" in name] == [  # the oldest was removed
        "fault-20300101T000003.000Z-GAP.mcap", "fault-20300101T000004.000Z-GAP.mcap"
    ]  # fmt: skip
    for _ in range(4):
        log.write(Fault.LINK)
    assert [path.exists() for _, path, _ in told] == [False] * 2 + [True] * 5


def full_disk(monkeypatch: pytest.MonkeyPatch, room: Callable[[], int], code: int = ENOSPC) -> None:
    """Let writing to a log fail beyond `room()` bytes."""

    class Full(io.FileIO):
        def write(self, data: Any) -> int:
            if self.tell() + len(data) > room():
                raise OSError(code, os.strerror(code))
            return super().write(data)

    monkeypatch.setattr("levid.log.writer._new_file", lambda path: Full(open_new(path), "wb"))


def kept_faults(
    tmp_path: Path, keep: int, there: int
) -> tuple[FaultLog, list[tuple[Fault, str, str]]]:
    """Return a fault log in a folder with `there` recordings, and its reports."""
    ring, told = Ring(DTYPE, 4000), []
    for k in range(there):
        (tmp_path / f"fault-19600101T00000{k}.000Z-GAP.mcap").touch()
    ring.rows["cycle"][:2000] = np.arange(2000)
    ring.head = 2000
    config = Recording(keep_faults=keep)
    return FaultLog(ring, 1e3, tmp_path, config, {}, lambda *of: told.append(of)), told


def test_full_disk_leaves_no_incomplete_flight_recording(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    log, told = kept_faults(tmp_path, 5, 5)
    full_disk(monkeypatch, lambda: 10_000)
    for _ in range(3):
        log.write(Fault.LINK)
    assert [path for _, path, _ in told] == [""] * 3
    assert "No space left" in told[0][2]
    names = sorted(path.name for path in tmp_path.iterdir())
    assert [name[20] for name in names] == list("1234")  # one was removed for the new one


@pytest.mark.parametrize(("keep", "there"), [(5, 4), (1, 1)])
def test_full_disk_removes_no_recording_below_the_limit_nor_the_last(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, keep: int, there: int
) -> None:
    log, told = kept_faults(tmp_path, keep, there)
    full_disk(monkeypatch, lambda: 10_000)
    log.write(Fault.LINK)
    assert told[0][1] == ""
    assert len(list(tmp_path.iterdir())) == there


def test_oldest_recording_is_removed_to_make_room(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    log, told = kept_faults(tmp_path, 3, 3)
    full_disk(monkeypatch, lambda: 10_000 if len(list(tmp_path.glob("*GAP*"))) == 3 else 10**9)
    log.write(Fault.LINK)
    assert not told[0][2]
    assert len(read_log(Path(told[0][1])).rows) == 2000
    assert len(list(tmp_path.iterdir())) == 3


def test_other_disk_error_removes_no_flight_recording(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    log, told = kept_faults(tmp_path, 3, 3)
    full_disk(monkeypatch, lambda: 10_000, EIO)
    log.write(Fault.LINK)
    assert "Input/output error" in told[0][2]
    assert sorted(path.name[20] for path in tmp_path.iterdir()) == list("012")


def test_flight_recording_without_summary_is_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    log, told = kept_faults(tmp_path, 3, 0)
    log.write(Fault.LINK)
    size = Path(told[0][1]).stat().st_size
    full_disk(monkeypatch, lambda: size - 100)
    log.write(Fault.LINK)
    assert "No space left" in told[1][2]
    assert len(read_log(Path(told[1][1])).rows) == 2000


def test_each_of_several_faults_in_a_second_is_recorded(tmp_path: Path) -> None:
    ring, told = Ring(DTYPE, 4000), []
    log = FaultLog(ring, 1e3, tmp_path, Recording(), {}, lambda *of: told.append(of))
    faults = ring.rows["fault"]
    ring.rows["cycle"][:3000] = np.arange(3000)
    faults[1000:1050], faults[1100:1200], faults[1300:1400] = Fault.GAP, Fault.STOPPED, Fault.POSE
    for head in (1010, 1250, 1320, 1550, 2500):  # two faults in one block
        ring.head = head
        taken = ring.take(4000)
        ring.tail = head
        log.scan(taken)
    assert [fault for fault, *_ in told] == [Fault.GAP, Fault.STOPPED, Fault.POSE]
    assert not any(error for *_, error in told)
    # Each recording continues for half a second.
    assert [int(read_log(Path(path)).rows["cycle"][-1]) for _, path, _ in told] == [
        1499, 1599, 1799
    ]  # fmt: skip
    assert log.idle


def test_fault_before_the_first_row_is_reported(tmp_path: Path) -> None:
    told: list[object] = []
    log = FaultLog(Ring(DTYPE, 4000), 1e3, tmp_path, Recording(), {}, lambda *of: told.append(of))
    log.write(Fault.LOOP)
    assert told == [(Fault.LOOP, "", NO_ROWS)]
    assert not list(tmp_path.iterdir())
