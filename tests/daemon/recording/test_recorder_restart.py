"""Test a recorder that replaces a dead one: empty parts, logs closed in the meantime."""

from __future__ import annotations

import os
import socket
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.records import Header
from mcap.writer import MCAP0_MAGIC
from recorder_in_thread import METADATA, Recording
from waiting import wait_until

from levid.config.rig import load_rig
from levid.config.shipped import shipped
from levid.daemon.control.faults import Fault
from levid.daemon.ipc.row_ring import HUNG_S, Ring
from levid.daemon.ipc.shared_memory import SharedMemory
from levid.daemon.ipc.shared_status_words import Word
from levid.daemon.recording.fault_recorder import FaultLog
from levid.daemon.recording.log_router import BLOCK, Event, LogFile, LogRouter
from levid.daemon.recording.recorder_process import RecorderProcess, without_empty_part
from levid.log.reader import read_log
from levid.log.signals import cycle_dtype
from levid.log.writer import LogWriter, record_bytes


def log(path: Path, rows: int) -> None:
    dtype = cycle_dtype(9, 9)
    with LogWriter(path, dtype, rate_hz=1e3, metadata=METADATA, attachments={}) as writer:
        if rows:
            writer.write(np.zeros(rows, dtype), np.arange(rows, dtype=np.uint64))


@pytest.mark.parametrize("cut", ["whole", "in its head", "before its first byte"])
def test_part_without_rows_is_replaced(tmp_path: Path, cut: str) -> None:
    path = tmp_path / "01-z.mcap"
    log(path, 0)
    size = {"whole": path.stat().st_size, "in its head": 20, "before its first byte": 0}[cut]
    with path.open("r+b") as file:
        file.truncate(size)
    assert without_empty_part(LogFile(path, METADATA, {})).part == 1
    assert not path.exists()


def test_part_with_rows_stays(tmp_path: Path) -> None:
    path = tmp_path / "01-z.mcap"
    log(path, 10)
    assert without_empty_part(LogFile(path, METADATA, {})).part == 2
    assert without_empty_part(LogFile(path, METADATA, {}, part=2)).part == 2
    assert path.exists()


@pytest.mark.parametrize(
    "data",
    [
        b"notes of an operator",
        # A log of another program, without rows or truncated.
        MCAP0_MAGIC + record_bytes(Header("", "libmcap 1.0")),
        MCAP0_MAGIC + record_bytes(Header("", "libmcap 1.0"))[:12],
    ],
)
def test_file_of_another_program_stays(tmp_path: Path, data: bytes) -> None:
    file = LogFile(tmp_path / "01-z.mcap", METADATA, {}, part=2)
    log(file.path, 10)
    for part in (2, 3):
        file.path_of(part).write_bytes(data)
    assert without_empty_part(file).part == 4
    for part in (2, 3):
        assert file.path_of(part).read_bytes() == data


def test_previous_part_without_rows_is_replaced(tmp_path: Path) -> None:
    file = LogFile(tmp_path / "01-z.mcap", METADATA, {}, part=3)
    log(file.path, 10)
    log(file.path_of(2), 0)
    assert without_empty_part(file).part == 2
    assert not file.path_of(2).exists()


@pytest.fixture
def recording(tmp_path: Path) -> Iterator[Recording]:
    made = Recording(tmp_path)
    yield made
    made.close()


def test_flight_closed_before_the_new_recorder_began_is_written(
    recording: Recording,
) -> None:
    recording.write(1, 1, 1, 2, 2, 2)
    recording.define(1)
    recording.tell({"forget": 1})
    recording.define(2)
    recording.start()
    wait_until(lambda: recording.event("closed", log=1))
    recording.tell({"forget": 2}, {"forget": 2})
    recording.finish()
    assert recording.cycles("1.mcap") == [0, 1, 2]
    assert recording.cycles("2.mcap") == [3, 4, 5]
    assert recording.shared.control_words[Word.DROPPED] == 0


def test_log_that_was_forgotten_twice_is_unknown(recording: Recording) -> None:
    """Definitions are not kept for ever."""
    recording.define(1)
    recording.tell({"forget": 1}, {"forget": 1})
    recording.start()
    recording.write(1)
    recording.finish()
    assert recording.event("failed", log=1, why="log 1 is unknown")


def test_log_that_continues_after_another_has_a_further_part(recording: Recording) -> None:
    recording.define(1)
    recording.write(1, 1, 1)
    recording.start()
    recording.tell({"fault": "LOOP"})  # it ends the present log
    wait_until(lambda: recording.event("fault", fault="LOOP"))
    recording.write(1, 1, 0, 1)
    recording.finish()
    assert not recording.event("failed")
    names = ("1.mcap", "1.2.mcap", "1.3.mcap")
    assert [recording.cycles(name) for name in names] == [[0, 1, 2], [3, 4], [6]]


@pytest.mark.parametrize(("behind_s", "lacking_s"), [(HUNG_S + 4.0, 0.0), (HUNG_S + 7.0, 2.0)])
def test_fault_before_a_hang_is_recorded_from_the_remaining_rows(
    recording: Recording, behind_s: float, lacking_s: float
) -> None:
    """It is killed after HUNG_S, and the next one takes its time to begin."""
    rate_hz, at, shared = 1000, 40_000, recording.shared
    ring, head = shared.ring, at + round(behind_s * rate_hz)
    numbers = np.arange(head - ring.capacity, head)
    ring.rows["cycle"][numbers % ring.capacity] = numbers
    ring.rows["fault"][numbers % ring.capacity] = Fault.GAP * (numbers >= at)
    ring.head, ring.tail, ring.durable = head, at, at
    shared.control_words[Word.FAULTS_SEEN] = at
    recording.start()
    recording.finish()
    (told,) = recording.events
    found = read_log(told["path"])
    assert found.rows["cycle"][-1] == at + 0.5 * rate_hz - 1
    before_s = (at - int(found.rows["cycle"][0])) / rate_hz
    assert before_s == pytest.approx(10.0 - lacking_s, abs=2.0 / rate_hz)
    assert float(found.metadata.get("lacks_s", 0.0)) == pytest.approx(10.0 - before_s)
    assert ("first 2.0 of 10 s" in told["why"]) == (lacking_s > 0.0)
    assert bool(told["why"]) == (lacking_s > 0.0)


def test_flight_recording_requested_between_two_logs_keeps_their_rows_in_order(
    recording: Recording,
) -> None:
    """The recorder waits for the definition of log 2; the recording needs all rows before it."""
    recording.define(1)
    recording.write(1, 1, 1, 2, 2, 2)
    recording.start()
    wait_until(lambda: recording.event("closed", log=1))
    recording.tell({"fault": "LOOP"})
    recording.define(2)
    recording.finish()
    order = [(event["event"], event.get("log")) for event in recording.events]
    assert order == [("opened", 1), ("closed", 1), ("opened", 2), ("closed", 2), ("fault", None)]
    (path,) = (recording.folder / "faults").iterdir()
    assert recording.cycles(str(path)) == list(range(6))
    assert [recording.cycles(f"{tag}.mcap") for tag in (1, 2)] == [[0, 1, 2], [3, 4, 5]]
    assert recording.shared.control_words[Word.DROPPED] == 0


def test_late_failure_of_an_earlier_flight_does_not_stop_the_next(recording: Recording) -> None:
    (recording.folder / "1.mcap").touch()  # no log is overwritten
    (recording.folder / "3.mcap").touch()
    recording.define(1)
    recording.tell({"forget": 1})
    for tag in (2, 3, 4):
        recording.define(tag)
    recording.write(1, 1, 2, 2, 3, 3, 4)  # the last rows of the first flight come after all
    recording.start()
    recording.finish()
    assert recording.cycles("2.mcap") == [2, 3]
    assert recording.shared.control_words[Word.DROPPED] == 5
    assert not (recording.folder / "4.mcap").exists()  # but a flight's own failure ends its logs


def test_unknown_log_is_reported_and_the_next_is_written(
    tmp_path: Path,
) -> None:
    told: list[tuple[Event, int]] = []
    ring = Ring(cycle_dtype(1, 1), 64)
    known = LogFile(tmp_path / "2.mcap", METADATA, {})
    router = LogRouter(ring, 1e3, {2: known}.get, lambda event, tag, *_: told.append((event, tag)))
    ring.tags[:6] = [1, 1, 1, 2, 2, 2]
    ring.head = 6
    while len(router.work().rows):
        pass
    router.finish()
    assert told == [(Event.FAILED, 1), (Event.OPENED, 2), (Event.CLOSED, 2)]
    assert router.dropped == 3
    assert len(read_log(known.path).rows) == 3


def test_recorder_pauses_unless_a_whole_block_waits(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # At 1 kHz the ring would not hold two blocks.
    rig = load_rig(shipped("rigs/loopback.yaml")).model_copy(update={"rate_hz": 2000.0})
    shared = SharedMemory(rig)
    ours, theirs = socket.socketpair()
    came, waits = [1, 1, 2 * BLOCK, 0, 1], []

    def select(*of: Any) -> tuple[list[object], list[object], list[object]]:
        waits.append(of[-1])
        if came:
            return [], [], []
        ours.sendall(b'{"end": true}\n')
        return [theirs], [], []

    def scan(*_: object) -> None:
        if came:  # while it works: at 10 kHz there is always one more row
            shared.ring.head += came.pop(0)

    monkeypatch.setattr("levid.daemon.recording.recorder_process.select.select", select)
    with ours, theirs:
        recorder = RecorderProcess(rig, shared, theirs, tmp_path)
        monkeypatch.setattr(FaultLog, "scan", scan)
        recorder.run(os.getppid())
        assert [wait_s > 0.0 for wait_s in waits] == [True, True, True, False, False, True, True]
        assert shared.ring.tail == shared.ring.head
    shared.close()
