"""Test journal entries with fields, and plain lines on a terminal."""

from __future__ import annotations

import os
import socket
import struct
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from levid.daemon.control.faults import Fault
from levid.daemon.control.states import State
from levid.daemon.ipc.shared_status_words import ControlWords, Word
from levid.daemon.service.journal import Journal, entry, moment


def fields_of(data: bytes) -> dict[str, str]:
    """Take an entry apart, by the rules of systemd's native protocol."""
    found = {}
    while data:
        line, _, rest = data.partition(b"\n")
        name, equals, value = line.partition(b"=")
        if not equals:
            (size,) = struct.unpack("<Q", rest[:8])
            value, rest = rest[8 : 8 + size], rest[8 + size + 1 :]
        found[name.decode()] = value.decode()
        data = rest
    return found


@pytest.mark.parametrize("text", ["a line", "two\nlines", "a = b", "Grüße"])
def test_an_entry_is_what_was_said(text: str) -> None:
    found = fields_of(entry(text, 3, {"LEVID_FAULT": "GAP", "LEVID_SESSION": ""}))
    assert found == {
        "MESSAGE": text,
        "PRIORITY": "3",
        "SYSLOG_IDENTIFIER": "levid",
        "LEVID_FAULT": "GAP",
    }


@pytest.fixture
def journal(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Iterator[tuple[socket.socket, Journal]]:
    """Return a socket as journald listens on, and what speaks to it as a service's stderr."""
    listening = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
    listening.bind(str(tmp_path / "socket"))
    listening.settimeout(30.0)
    with (tmp_path / "stderr").open("w") as stderr:
        monkeypatch.setattr(sys, "stderr", stderr)
        found = os.fstat(stderr.fileno())
        monkeypatch.setenv("JOURNAL_STREAM", f"{found.st_dev}:{found.st_ino}")
        yield listening, Journal(str(tmp_path / "socket"))
    listening.close()


def test_a_fault_is_an_error_with_its_name(journal: tuple[socket.socket, Journal]) -> None:
    listening, speaking = journal
    speaking.log("ready")
    speaking.log("warning: something")
    speaking.fields = lambda: {"LEVID_FAULT": "GAP"}
    speaking.log("fault GAP")
    found = [fields_of(listening.recv(4096)) for _ in range(3)]
    assert [entry["PRIORITY"] for entry in found] == ["6", "4", "3"]
    assert found[2]["LEVID_FAULT"] == "GAP"


def test_every_process_says_which_rig_and_in_what_state(
    journal: tuple[socket.socket, Journal],
) -> None:
    listening, speaking = journal
    control_words = ControlWords(memoryview(bytearray(ControlWords.SIZE)))
    speaking.fields = lambda: moment("here", control_words)
    speaking.log("warning: realtime.priority 80")
    control_words[Word.STATE], control_words[Word.FAULT] = State.FAULT, Fault.LINK
    speaking.log("no flight recording")
    calm, faulty = (fields_of(listening.recv(4096)) for _ in range(2))
    assert (calm["LEVID_RIG"], calm["LEVID_STATE"], calm["PRIORITY"]) == ("here", "OFF", "4")
    assert "LEVID_FAULT" not in calm
    assert (faulty["LEVID_FAULT"], faulty["LEVID_STATE"]) == ("LINK", "FAULT")


def test_without_its_socket_the_line_goes_to_stderr(
    journal: tuple[socket.socket, Journal], tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "socket").unlink()
    journal[1].log("still heard")
    journal[1].close()
    assert capfd.readouterr().err == "still heard\n"


def test_a_terminal_gets_lines(capfd: pytest.CaptureFixture[str]) -> None:
    journal = Journal()
    journal.log("a line")
    journal.close()
    assert capfd.readouterr().err == "a line\n"


_SPEAKER = """
import sys, time
from levid.daemon.service.journal import Journal
journal = Journal()
begin_s = time.monotonic()
for i in range(5000):
    journal.log("x" * 100)
said_s = time.monotonic() - begin_s
journal.close()
print(said_s)
"""


@pytest.mark.parametrize("stderr", ["full", "stopped", "gone"])
def test_stderr_that_takes_nothing_holds_nobody_up(stderr: str) -> None:
    """A full disk, a terminal where nobody reads on, a reader that is gone."""
    reading, writing = os.pipe()
    if stderr == "full":
        os.close(writing)
        writing = os.open("/dev/full", os.O_WRONLY)
    if stderr == "gone":
        os.close(reading)
    done = subprocess.run(
        [sys.executable, "-c", _SPEAKER],
        stderr=writing,
        stdout=subprocess.PIPE,
        timeout=60,
        check=False,
    )
    os.close(writing)
    if stderr != "gone":
        os.close(reading)
    assert done.returncode == 0
    assert float(done.stdout) < 30.0  # it said them all, and did not wait for ever


def test_what_is_no_text_is_said_all_the_same(
    journal: tuple[socket.socket, Journal], tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """A client may ask for a folder whose name is none: whoever tells of it must not die of it."""
    listening, speaking = journal
    speaking.log("no folder \ud800")
    assert fields_of(listening.recv(4096))["MESSAGE"] == "no folder \\ud800"
    (tmp_path / "socket").unlink()
    speaking.log("no folder \ud800")
    speaking.close()
    assert capfd.readouterr().err == "no folder \\ud800\n"
