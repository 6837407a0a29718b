"""Test the supervisor's link to the recorder: problems, restarts, a recorder that hangs."""

from __future__ import annotations

import json
import os
import socket
from collections.abc import Iterator, Sequence
from errno import ENOMEM
from pathlib import Path
from typing import Any

import pytest

from levid.config.rig import load_rig
from levid.config.shipped import shipped
from levid.daemon.control.faults import Fault
from levid.daemon.ipc.json_lines import Lines
from levid.daemon.ipc.row_ring import HUNG_S
from levid.daemon.ipc.shared_memory import SharedMemory
from levid.daemon.ipc.shared_status_words import Word
from levid.daemon.recording.fault_recorder import NO_ROWS
from levid.daemon.recording.log_router import Event, LogFile
from levid.daemon.recording.recorder_link import RecorderLink

MODULE = "levid.daemon.recording.recorder_link"
TICK_S = 0.05


class PlayedRecorder:
    """A recorder process that a test plays, at its end of the socket; it lives for `lives_s`."""

    def __init__(self) -> None:
        self.now_s, self.started_s = 1000.0, list[float]()
        self.running, self.end, self.waited_s, self.pid = False, "exit code 1", 0.0, None
        self.kills, self.starts = 0, True
        self._lines: Lines | None = None

    def start(self, _: Sequence[object], fds: Sequence[int]) -> None:
        if not self.starts:
            raise OSError(ENOMEM, os.strerror(ENOMEM))
        self.close()
        self._lines = Lines(socket.socket(fileno=os.dup(fds[1])), 1 << 20, 1 << 20)
        self.started_s.append(self.now_s)
        self.running = True

    def kill(self, *_: float) -> None:
        self.kills += 1  # it waits for a disk in the kernel

    def tell(self, **message: object) -> None:
        assert self._lines is not None
        self._lines.put(message)

    def heard(self) -> list[dict[str, Any]]:
        """Return the messages since the last call."""
        assert self._lines is not None
        self._lines.receive()
        return [json.loads(line) for line in self._lines.lines()]

    def close(self) -> None:
        if self._lines is not None:
            self._lines.close()


class Bench:
    """A link to a played recorder, in virtual time."""

    def __init__(self, recorder: PlayedRecorder, folder: Path) -> None:
        self.recorder, self.folder, self.logged = recorder, folder, list[str]()
        self.shared = SharedMemory(load_rig(shipped("rigs/loopback.yaml")))
        self.control_words = self.shared.control_words
        self.link = RecorderLink(
            b"{}", self.shared.fd, self.control_words, folder / "faults", self.logged.append
        )

    def watch(self, seconds: float = TICK_S, lives_s: float = 1e9, beats: bool = False) -> None:
        """Let the supervisor watch for a time, while each recorder lives for `lives_s`."""
        for _ in range(round(seconds / TICK_S)):
            self.recorder.now_s += TICK_S
            self.control_words[Word.RECORDER_BEAT] += beats
            self.link.watch()
            if self.recorder.running:
                lived_s = self.recorder.now_s - self.recorder.started_s[-1]
                self.recorder.running = lived_s < lives_s

    def tell(self, event: str, **message: object) -> None:
        self.recorder.tell(event=event, **message)
        self.link.receive()

    def tell_fault(self, path: str, why: str = "", fault: str = "GAP") -> None:
        self.tell("fault", fault=fault, path=path, why=why)

    def define(self, name: str) -> int:
        return self.link.define(LogFile(self.folder / name, {}, {}))


@pytest.fixture
def bench(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Bench]:
    recorder = PlayedRecorder()
    monkeypatch.setattr(f"{MODULE}.Child", lambda *_: recorder)
    monkeypatch.setattr(f"{MODULE}.time.monotonic", lambda: recorder.now_s)
    bench = Bench(recorder, tmp_path)
    yield bench
    recorder.close()
    bench.shared.close()


def test_recorder_that_replaces_a_dead_one_gets_its_unconfirmed_requests(bench: Bench) -> None:
    link, recorder = bench.link, bench.recorder

    def restarted() -> list[dict[str, Any]]:
        recorder.running = False
        bench.watch(120.0, beats=True)  # longer than any pause between two starts
        return recorder.heard()

    bench.watch()
    link.fault(Fault.LOOP)
    assert recorder.heard() == [{"fault": "LOOP"}]
    assert restarted() == [{"fault": "LOOP"}]
    link.forget()  # a flight has begun since: it is no part of that fault
    assert recorder.heard() == [{"forget": 0}]
    assert restarted() == []
    link.fault(Fault.LOOP)
    assert recorder.heard() == [{"fault": "LOOP"}]
    bench.tell_fault(str(bench.folder / "a.mcap"), fault="LOOP")
    assert restarted() == []


def test_hanging_recorder_is_a_problem_until_it_goes_on(bench: Bench) -> None:
    """It waits for a disk in the kernel, where it cannot be killed."""
    bench.watch()
    bench.watch(beats=True)  # it has begun
    bench.recorder.now_s += 60.0  # the machine was suspended
    bench.watch()
    assert not bench.recorder.kills
    bench.watch(HUNG_S + 0.2)
    assert bench.logged == [f"killed the recorder: it hung for {HUNG_S:g} s"]
    assert "hangs" in bench.link.problem
    bench.watch(beats=True)  # its disk answers
    assert not bench.link.problem


@pytest.mark.parametrize("begun", [False, True])
def test_recorder_on_a_starved_machine_is_not_killed(bench: Bench, begun: bool) -> None:
    """It gets a twentieth of a processor: 400 s make 20 s."""
    bench.watch()
    bench.watch(beats=begun)
    for _ in range(round(400.0 / TICK_S)):
        bench.recorder.waited_s += 0.95 * TICK_S
        bench.watch()
    assert bool(bench.recorder.kills) is begun  # 20 s are too long once it has begun
    if begun:
        assert f"hung for {HUNG_S:g} s" in bench.logged[0]
    bench.recorder.kills = 0
    bench.watch(100.0)  # it is blocked, or in a loop of its own
    assert bench.recorder.kills


def test_failed_flight_recording_is_a_problem_until_something_is_written(bench: Bench) -> None:
    link = bench.link
    bench.watch()
    bench.tell_fault("/a.mcap")
    bench.tell_fault("", NO_ROWS)
    assert not link.problem  # nothing failed
    before = bench.define("0.mcap")
    of_log = {"log": before, "path": str(bench.folder / "0.mcap"), "why": ""}
    bench.tell(Event.OPENED, **of_log)
    bench.tell_fault("", "No space left on device")
    assert link.problem == "flight recording of GAP: No space left on device"
    assert link.last_fault_log == "/a.mcap"
    bench.tell(Event.CLOSED, **of_log)  # for its end there was room
    link.forget()
    assert "No space left" in link.problem
    of_log = {"log": bench.define("1.mcap"), "path": "1", "why": ""}
    bench.tell(Event.OPENED, **of_log)
    assert link.problem
    bench.tell(Event.CLOSED, **of_log)
    assert not link.problem
    bench.tell_fault("", "No space left on device")
    bench.tell_fault("/b.mcap")
    assert (link.problem, link.last_fault_log) == ("", "/b.mcap")


def test_failed_log_is_a_problem_until_a_flight_recording_is_written(bench: Bench) -> None:
    link = bench.link
    bench.watch()
    tag = bench.define("1.mcap")
    bench.tell(Event.FAILED, log=tag, path="1", why="No space left")
    assert link.problem == "No space left"
    bench.tell_fault("/a.mcap")
    assert not link.problem
    assert link.failed == {tag: "No space left"}  # the client that requested the log is told
    bench.tell(Event.FAILED, log=tag, path="1", why="No space left")
    link.forget()
    assert not link.problem


@pytest.mark.parametrize("beats", [False, True])
def test_pause_grows_if_the_recorder_dies_at_each_start(bench: Bench, beats: bool) -> None:
    started_s, logged = bench.recorder.started_s, bench.logged
    bench.watch(20.0, 20.0, beats=True)
    bench.watch(0.2, 0.1, beats=beats)
    assert [s - 1000.0 for s in started_s] == pytest.approx([0.05, 20.1], abs=0.06)  # at once
    bench.watch(3600.0, 0.1, beats=beats)
    assert 60 < len(started_s) < 75
    assert started_s[-1] - started_s[-2] == pytest.approx(60.0, abs=0.2)
    assert 55 < len(logged) <= 62
    assert "the recorder ended (exit code 1)" in logged[-1]
    assert "similar events" in logged[1]
    bench.watch(75.0, 15.0, beats=True)  # the cause is removed, and it dies of another one
    assert 58.0 < started_s[-3] - started_s[-4] < 62.0
    assert started_s[-1] - started_s[-2] == pytest.approx(15.0, abs=0.2)
    bench.watch(15.0, beats=True)
    bench.recorder.running = False
    count = len(started_s)
    bench.watch(0.1, beats=True)
    assert len(started_s) == count + 1


def test_recorder_that_the_kernel_does_not_start_is_logged_once_a_minute(bench: Bench) -> None:
    bench.recorder.starts = False
    bench.watch(50.0)
    assert bench.logged == ["cannot start the recorder: [Errno 12] Cannot allocate memory"]
