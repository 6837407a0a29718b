"""Test Ctrl-C: exit code 130 without a traceback, wherever the command is."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from levid.daemon.recording.post_processing import hand_over
from levid.log.catalogue.run_summary import unflown_steps
from levid.log.reader import read_log

# Python sends SIGINT to itself at the n-th event of a kind: a call of a function in a module that
# is being imported, or in the command. That is every instant, one after the other, without a clock.
RUN = """
import os, signal, sys
signal.signal(signal.SIGINT, signal.default_int_handler)  # a background job ignores it
at, step = int(sys.argv.pop(1)), 0
from levid.cli import entry  # its first line has been run when the events begin

def count(frame, event, argument):
    global step
    if event in ("call", "c_call"):
        step += 1
        if step == at:
            sys.setprofile(None)
            os.kill(os.getpid(), signal.SIGINT)

sys.setprofile(count)
entry.main()
"""
SWALLOW = """
import os, signal, sys, time
signal.signal(signal.SIGINT, signal.default_int_handler)
from levid.cli import entry
from levid.cli import main as commands

class Finalised:
    def __del__(self):
        os.kill(os.getpid(), signal.SIGINT)
        time.sleep(0.01)  # the exception is raised here, where Python ignores it

def command(**_):
    Finalised()
    time.sleep(60)
    return 0

commands.levid = command
entry.main()
"""
REPLACE = SWALLOW.replace(
    "    Finalised()\n",
    """    try:
        os.kill(os.getpid(), signal.SIGINT)
        time.sleep(60)
    except KeyboardInterrupt:
        raise ImportError("numpy.core.multiarray failed to import") from None
""",
)
AT_EXIT = """
import os, signal, sys
signal.signal(signal.SIGINT, signal.default_int_handler)
from levid.cli import entry
from levid.cli import main as commands

class Finalised:
    kill, signal, pid = os.kill, signal.SIGINT, os.getpid()
    def __del__(self):
        self.kill(self.pid, self.signal)

kept = Finalised()  # Python deletes it after it has restored its own signal handlers
commands.levid = lambda **_: 0
entry.main()
"""
WAITING_CHILD = """
import signal, sys, time
signal.signal(signal.SIGINT, signal.default_int_handler)
sys.stderr.write("begun\\n")
try:
    time.sleep(60)
except KeyboardInterrupt:
    time.sleep(1.0)  # longer than subprocess.run lets a child clean up
    open(sys.argv[-1], "w").write("cleaned up")
"""


def run(code: str, *arguments: object, cwd: Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-c", code, *map(str, arguments)],
        capture_output=True, text=True, check=False, cwd=cwd, timeout=120,
    )  # fmt: skip


@pytest.mark.parametrize("at", [1, 10, 1000, 20_000, 80_000, 150_000])
def test_an_interrupt_at_any_call_ends_without_a_traceback(tmp_path: Path, at: int) -> None:
    done = run(RUN, at, "list", tmp_path, cwd=tmp_path)
    assert "Traceback" not in done.stderr
    assert "Exception ignored" not in done.stderr
    # The command makes some 100,000 calls: the last instants lie behind its end.
    assert (done.returncode, done.stderr) == (130, "interrupted\n") or at >= 80_000


@pytest.mark.parametrize("code", [SWALLOW, REPLACE], ids=["ignored", "replaced"])
def test_an_interrupt_that_python_or_a_library_takes_ends_the_command(
    tmp_path: Path, code: str
) -> None:
    done = run(code, cwd=tmp_path)
    assert (done.returncode, done.stderr) == (130, "interrupted\n")


def test_an_interrupt_while_python_ends_changes_nothing(tmp_path: Path) -> None:
    done = run(AT_EXIT, cwd=tmp_path)
    assert (done.returncode, done.stderr) == (0, "")


def test_a_background_job_keeps_ignoring_the_interrupt(tmp_path: Path) -> None:
    code = RUN.replace("signal.default_int_handler", "signal.SIG_IGN")
    done = run(code, 10, "list", tmp_path, cwd=tmp_path)
    assert done.returncode == 0


def test_a_command_after_landing_may_clean_up_before_the_session_ends(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    script = tmp_path / "levid"
    script.write_text(f"#!/bin/sh\nexec {sys.executable} -c '{WAITING_CHILD}' \"$@\"\n")
    script.chmod(0o755)
    monkeypatch.setattr("sys.executable", str(script))
    with pytest.raises(KeyboardInterrupt):
        _interrupted_while_waiting(tmp_path / "cleaned.txt")
    assert (tmp_path / "cleaned.txt").read_text() == "cleaned up"


def _interrupted_while_waiting(out: Path) -> None:
    import threading

    read, write = os.pipe()
    stderr = os.dup(2)
    os.dup2(write, 2)

    def interrupt() -> None:
        os.read(read, 6)
        os.kill(os.getpid(), signal.SIGINT)

    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    thread = threading.Thread(target=interrupt)
    thread.start()
    try:
        hand_over("identify", [Path("a.mcap")], out)
    finally:
        signal.signal(signal.SIGINT, before)
        os.dup2(stderr, 2)
        for number in (read, write, stderr):
            os.close(number)
        thread.join()


SESSION = """
levid: session
name: broken-off
steps:
  - levitate: {}
  - record: {name: long, duration_s: 600}
  - land: {}
"""
FLY = """
import os, signal, sys, threading, time
from pathlib import Path
signal.signal(signal.SIGINT, signal.default_int_handler)
from levid.cli import entry

def interrupt():
    log = Path("out/01-long.mcap")
    while not log.exists() or log.stat().st_size < 500_000:
        time.sleep(0.01)
    os.kill(os.getpid(), signal.SIGINT)

threading.Thread(target=interrupt, daemon=True).start()
sys.argv[1:] = ["excite", "session.yaml", "--virtual", "--out", "out"]
entry.main()
"""


def test_the_log_of_a_flight_broken_off_says_that_it_was_cut_off(tmp_path: Path) -> None:
    (tmp_path / "session.yaml").write_text(SESSION)
    done = run(FLY, cwd=tmp_path)
    assert (done.returncode, done.stderr.strip()) == (130, "interrupted")
    whole, cut = (
        read_log(tmp_path / "out" / f"{name}.mcap") for name in ("00-levitate", "01-long")
    )
    assert whole.complete
    assert not cut.complete
    assert cut.rows.size > 0
    assert unflown_steps([whole.metadata, cut.metadata]) == 1


def test_steps_without_a_log_are_counted() -> None:
    logs = [{"step": "0", "steps": "3"}, {"step": "1", "steps": "3", "part": "2"}]
    assert unflown_steps(logs) == 1
    assert unflown_steps([*logs, {"step": "2", "steps": "3"}]) == 0
    assert unflown_steps([{"step": "0"}]) == 0  # logs of earlier versions do not say
