"""Test `levid electronics`: answers on a bus, and one line printed per command."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from queue import Queue

import pytest
import yaml

from levid.config.rig import RigConfig
from levid.config.shipped import shipped
from levid.sim.electronics.faults import FAULTS
from levid.wire.can.can_frames import load_frames
from levid.wire.can.kernel_frame import BusOffError, ReceivedFrame
from levid.wire.can.local_bus import LocalFrames

WAIT_S = 60.0
FRAMES = load_frames(None, 9, 9, True)


class Command:
    """Run the command in a process; queues contain the lines that it prints."""

    def __init__(self, *arguments: object) -> None:
        self.process = subprocess.Popen(
            [sys.executable, "-m", "levid.cli.main", "electronics", *map(str, arguments)],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        )  # fmt: skip
        self.out: Queue[str] = Queue()
        self.err: Queue[str] = Queue()
        for stream, lines in ((self.process.stdout, self.out), (self.process.stderr, self.err)):
            threading.Thread(target=self._read, args=(stream, lines), daemon=True).start()

    @staticmethod
    def _read(stream, lines: Queue[str]) -> None:
        for line in stream:
            lines.put(line.rstrip("\n"))

    def answer(self, line: str) -> str:
        assert self.process.stdin is not None
        self.process.stdin.write(f"{line}\n")
        self.process.stdin.flush()
        return self.out.get(timeout=WAIT_S)


@pytest.fixture
def rig_file(rig_on, tmp_path: Path) -> Path:
    rig: RigConfig = rig_on("canlocal", 50.0, shipped("sims/nominal.yaml"))
    path = tmp_path / "rig.yaml"
    path.write_text(yaml.safe_dump(rig.model_dump(mode="json")))
    return path


@pytest.fixture
def command(rig_file: Path) -> Iterator[Command]:
    command = Command(rig_file)
    try:
        assert "Ctrl-C" in command.err.get(timeout=WAIT_S)
        yield command
    finally:
        command.process.kill()
        command.process.wait()


def answers(bus: LocalFrames, cycle: int, seconds: float) -> set[int]:
    """Return the IDs received within `seconds` of a Sync; end early when both kinds arrived."""
    bus.send(*FRAMES.sync.encode(cycle))
    expected, found = {*FRAMES.gap.ids, *FRAMES.force.ids}, set()
    until_s = time.monotonic() + seconds
    while not expected <= found and time.monotonic() < until_s:
        frame = bus.receive(0.1)
        if isinstance(frame, ReceivedFrame):
            found.add(frame.can_id)
    return expected & found


def test_every_command_prints_one_line(command: Command) -> None:
    text = command.answer("help")
    assert all(name in text for name in FAULTS)
    assert "trip CHANNEL:" in text
    status = json.loads(command.answer("status"))
    assert status["amplifiers"] == status["drives"] == "OFF"
    assert status["sensors"] == "OK"
    assert len(status["acting_n"]) == 9
    for line, fault in (("drop", "drop"), ("trip 3", None), ("push -2.5", None)):
        assert command.answer(line) == line
        if fault:
            assert fault in json.loads(command.answer("status"))["wire"]
    assert command.answer("\n  clear") == "clear"  # an empty line is ignored
    assert json.loads(command.answer("status"))["wire"] == []


def test_wrong_command_prints_what_is_expected(command: Command) -> None:
    for line, words in (
        ("fly", "error: expected clear or one of drop, "),
        ("trip", "error: trip: expected channel"),
        ("trip 9", "error: trip: expected a channel from 0 to 8, found '9'"),
        ("drop 1", "error: drop: expected no argument"),
        ("encoder z", "error: encoder: expected one of x1, x2, phi"),
        ("push nan", "error: push: expected a finite number, found 'nan'"),
    ):
        assert command.answer(line).startswith(words)
    assert command.answer("clear") == "clear"  # the process still runs


def test_electronics_answer_on_the_bus_until_sigterm(command: Command, tmp_path: Path) -> None:
    bus = LocalFrames(tmp_path / "bus", True)
    assert len(answers(bus, 7, WAIT_S)) == 2
    command.answer("drop")
    assert answers(bus, 8, 0.5) == set()
    command.answer("clear")
    assert len(answers(bus, 9, WAIT_S)) == 2
    command.answer("bus-off")
    with pytest.raises(BusOffError):
        answers(bus, 10, WAIT_S)
    command.answer("clear")
    assert command.process.stdin is not None
    command.process.stdin.close()  # the process continues without standard input
    assert len(answers(bus, 11, WAIT_S)) == 2
    bus.shutdown()
    command.process.send_signal(signal.SIGTERM)
    assert command.process.wait(WAIT_S) == 0
    assert list((tmp_path / "bus").iterdir()) == []  # its bus node is removed
    assert command.err.empty()


def test_rig_without_bus_roles_is_rejected() -> None:
    command = Command(shipped("rigs/loopback.yaml"))
    assert command.process.wait(WAIT_S) != 0
    assert "expected a backend with emulated electronics" in command.err.get(timeout=WAIT_S)
