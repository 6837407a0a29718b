"""Test a recorder that replaces a dead one: empty parts, logs closed in the meantime."""

from __future__ import annotations

import json
import os
import socket
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from mcap.records import Header
from mcap.writer import MCAP0_MAGIC

from levid.config.rig import load_rig
from levid.config.shipped import shipped
from levid.daemon.control.faults import Fault
from levid.daemon.ipc.control_words import Word
from levid.daemon.ipc.row_ring import HUNG_S, Ring
from levid.daemon.ipc.shared_memory import SharedMemory
from levid.daemon.recording.log_router import BLOCK, Event, LogFile, LogRouter
from levid.daemon.recording.recorder_process import RecorderProcess, without_empty_part
from levid.log.reader import read_log
from levid.log.signals import cycle_dtype
from levid.log.writer import LogWriter, record_bytes

METADATA = {"kind": "record", "name": "z"}


def log(path: Path, rows: int) -> None:
    dtype = cycle_dtype(9, 9)
    with LogWriter(path, dtype, rate_hz=1e3, metadata=METADATA, attachments={}) as writer:
        if rows:
            writer.write(np.zeros(rows, dtype), np.arange(rows, dtype=np.uint64))


@pytest.mark.parametrize("cut", ["whole", "in its head", "before its first byte"])
def test_part_that_nobody_was_told_of_is_taken_up_again(tmp_path: Path, cut: str) -> None:
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
        # Another's log that has no rows, or was cut off.
        MCAP0_MAGIC + record_bytes(Header("", "libmcap 1.0")),
        MCAP0_MAGIC + record_bytes(Header("", "libmcap 1.0"))[:12],
    ],
)
def test_what_somebody_else_has_put_there_stays(tmp_path: Path, data: bytes) -> None:
    file = LogFile(tmp_path / "01-z.mcap", METADATA, {}, part=2)
    log(file.path, 10)
    for part in (2, 3):
        file.path_of(part).write_bytes(data)
    assert without_empty_part(file).part == 4
    for part in (2, 3):
        assert file.path_of(part).read_bytes() == data


def test_part_before_without_rows_goes(tmp_path: Path) -> None:
    file = LogFile(tmp_path / "01-z.mcap", METADATA, {}, part=3)
    log(file.path, 10)
    log(file.path_of(2), 0)
    assert without_empty_part(file).part == 2
    assert not file.path_of(2).exists()


def test_flight_that_was_closed_before_the_new_recorder_began_is_written(tmp_path: Path) -> None:
    rig = load_rig(shipped("rigs/loopback.yaml"))
    shared = SharedMemory(rig)
    ours, theirs = socket.socketpair()
    with ours, theirs:
        recorder = RecorderProcess(rig, shared, theirs, tmp_path)

        def tell(*messages: dict[str, object]) -> None:
            ours.sendall(b"".join(json.dumps(m).encode() + b"\n" for m in messages))
            recorder._receive(1.0)

        def log_of(tag: int) -> dict[str, object]:
            path = str(tmp_path / f"{tag}.mcap")
            return {"log": tag, "path": path, "metadata": METADATA, "part": 1, "again": False}

        shared.ring.tags[:6] = [1, 1, 1, 2, 2, 2]
        shared.ring.head = 6
        tell(log_of(1), {"forget": 1}, log_of(2))
        while len(recorder._scribe.work().rows):
            pass
        recorder._scribe.finish()
        assert [len(read_log(tmp_path / f"{tag}.mcap").rows) for tag in (1, 2)] == [3, 3]
        assert recorder._scribe.dropped == 0
        tell({"forget": 2}, {"forget": 2})
        assert not recorder._logs  # nothing is kept for ever
    shared.close()


class Recording:
    """A recorder in this process, and the supervisor's end of its conversation."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.shared = folder, SharedMemory(load_rig(shipped("rigs/loopback.yaml")))
        rig = load_rig(shipped("rigs/loopback.yaml"))
        self.rig = rig
        self.ours, self.theirs = socket.socketpair()
        self.recorder = RecorderProcess(rig, self.shared, self.theirs, folder / "faults")

    def tell(self, *messages: dict[str, object]) -> None:
        self.ours.sendall(b"".join(json.dumps(m).encode() + b"\n" for m in messages))
        self.recorder._receive(1.0)

    def define(self, tag: int) -> None:
        path = str(self.folder / f"{tag}.mcap")
        file = {"path": path, "metadata": METADATA, "part": 1, "again": False}
        self.tell({"log": tag, **file})

    def write(self, *tags: int) -> None:
        ring = self.shared.ring
        ring.tags[ring.head : ring.head + len(tags)] = tags
        ring.head += len(tags)
        while len(self.recorder._scribe.work().rows):
            pass

    def close(self) -> None:
        self.ours.close()
        self.recorder._lines.close()
        self.shared.close()


@pytest.fixture
def recording(tmp_path: Path) -> Iterator[Recording]:
    made = Recording(tmp_path)
    yield made
    made.close()


def test_log_that_is_gone_on_with_after_others_has_another_part(recording: Recording) -> None:
    recording.define(1)
    recording.write(1, 1, 1)
    recording.tell({"fault": "LOOP"})  # it ends the log at hand
    recording.write(1, 1, 0, 1)
    recording.recorder._scribe.finish()
    assert recording.recorder._scribe.error is None
    names = ("1.mcap", "1.2.mcap", "1.3.mcap")
    assert [len(read_log(recording.folder / name).rows) for name in names] == [3, 2, 1]


@pytest.mark.parametrize(("behind_s", "lacking_s"), [(HUNG_S + 4.0, 0.0), (HUNG_S + 7.0, 2.0)])
def test_fault_as_the_recorder_began_to_hang_is_recorded_as_far_as_rows_are_there(
    tmp_path: Path, behind_s: float, lacking_s: float
) -> None:
    """It is killed after HUNG_S, and the next one takes its time to begin."""
    recording, rate_hz, at = Recording(tmp_path), 1000, 40_000
    try:
        shared = recording.shared
        ring, head = shared.ring, at + round(behind_s * rate_hz)
        numbers = np.arange(head - ring.capacity, head)
        ring.rows["cycle"][numbers % ring.capacity] = numbers
        ring.rows["fault"][numbers % ring.capacity] = Fault.GAP * (numbers >= at)
        ring.head, ring.tail, ring.durable = head, at, at
        shared.board[Word.FAULTS_SEEN] = at
        again = RecorderProcess(recording.rig, shared, recording.theirs.dup(), tmp_path / "faults")
        while len((taken := again._scribe.work()).rows):
            again._faults.scan(taken)
        again._lines.close()
        (told,) = map(json.loads, recording.ours.recv(4096).splitlines())
        found = read_log(told["path"])
        assert found.rows["cycle"][-1] == at + 0.5 * rate_hz - 1
        before_s = (at - int(found.rows["cycle"][0])) / rate_hz
        assert before_s == pytest.approx(10.0 - lacking_s, abs=2.0 / rate_hz)
        assert float(found.metadata.get("lacks_s", 0.0)) == pytest.approx(10.0 - before_s)
        assert ("first 2.0 of 10 s" in told["why"]) == (lacking_s > 0.0)
        assert bool(told["why"]) == (lacking_s > 0.0)
    finally:
        recording.close()


def test_fault_that_is_asked_for_as_the_scribe_waits_for_a_log_comes_after_its_work(
    recording: Recording,
) -> None:
    """It has the scribe work: in the middle of its work rows would be written in another order."""
    recorder, ring = recording.recorder, recording.shared.ring
    ring.rows["cycle"][:6] = range(6)
    ring.tags[:6] = [1, 1, 1, 2, 2, 2]
    ring.head = 6
    recording.define(1)
    file = {"path": str(recording.folder / "2.mcap"), "metadata": METADATA, "part": 1}
    messages = ({"fault": "LOOP"}, {"log": 2, **file, "again": False})
    recording.ours.sendall(b"".join(json.dumps(m).encode() + b"\n" for m in messages))
    while len(recorder._scribe.work().rows):
        pass
    assert not (recording.folder / "faults").exists()
    recorder._receive(0.0)
    (path,) = (recording.folder / "faults").iterdir()
    assert read_log(path).rows["cycle"].tolist() == list(range(6))
    for tag, cycles in ((1, [0, 1, 2]), (2, [3, 4, 5])):
        assert read_log(recording.folder / f"{tag}.mcap").rows["cycle"].tolist() == cycles
    assert recorder._scribe.dropped == 0


def test_late_failure_of_a_flight_that_is_over_stops_no_other(recording: Recording) -> None:
    (recording.folder / "1.mcap").touch()  # no log is written over
    (recording.folder / "3.mcap").touch()
    recording.define(1)
    recording.tell({"forget": 1})
    for tag in (2, 3, 4):
        recording.define(tag)
    recording.write(1, 1, 2, 2, 3, 3, 4)  # the last rows of the first flight come after all
    recording.recorder._scribe.finish()
    assert len(read_log(recording.folder / "2.mcap").rows) == 2
    assert recording.recorder._scribe.dropped == 5
    assert not (recording.folder / "4.mcap").exists()  # but a flight's own failure ends its logs


def test_log_that_nobody_knows_is_told_and_keeps_no_other_from_being_written(
    tmp_path: Path,
) -> None:
    told: list[tuple[Event, int]] = []
    ring = Ring(cycle_dtype(1, 1), 64)
    known = LogFile(tmp_path / "2.mcap", METADATA, {})
    scribe = LogRouter(ring, 1e3, {2: known}.get, lambda event, tag, *_: told.append((event, tag)))
    ring.tags[:6] = [1, 1, 1, 2, 2, 2]
    ring.head = 6
    while len(scribe.work().rows):
        pass
    scribe.finish()
    assert told == [(Event.FAILED, 1), (Event.OPENED, 2), (Event.CLOSED, 2)]
    assert scribe.dropped == 3
    assert len(read_log(known.path).rows) == 3


def test_recorder_pauses_unless_a_whole_block_waits(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # At 1 kHz the ring would not hold two blocks.
    rig = load_rig(shipped("rigs/loopback.yaml")).model_copy(update={"rate_hz": 2000.0})
    shared = SharedMemory(rig)
    ours, theirs = socket.socketpair()
    came, waits = [1, 1, 2 * BLOCK, 0, 1], []
    with ours, theirs:
        recorder = RecorderProcess(rig, shared, theirs, tmp_path)

        def receive(wait_s: float) -> None:
            waits.append(wait_s)
            recorder._ending = not came

        def scan(_: object) -> None:
            if came:  # while it works: there is always one more at 10 kHz
                shared.ring.head += came.pop(0)

        monkeypatch.setattr(recorder, "_receive", receive)
        monkeypatch.setattr(recorder._faults, "scan", scan)
        recorder.run(os.getppid())
        assert [wait_s > 0.0 for wait_s in waits] == [True, True, True, False, False, True, True]
        assert shared.ring.tail == shared.ring.head
    shared.close()
