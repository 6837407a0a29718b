"""Test the silence of a child: time without a processor does not count."""

from __future__ import annotations

import os
import signal
from pathlib import Path
from typing import Any

import pytest
from waiting import wait_until

from levid.daemon.host.child_process import Child, ChildSilence


class Starved:
    """A child that waits for a processor for a share of all time, from `since_s` on."""

    def __init__(self, share: float, since_s: float = 0.0) -> None:
        self.now_s, self.share, self.since_s = 0.0, share, since_s

    @property
    def waited_s(self) -> float:
        return self.share * max(self.now_s - self.since_s, 0.0)


@pytest.mark.parametrize("share", [0.0, 0.5, 0.99])
def test_silence_excludes_time_without_a_processor(share: float) -> None:
    child: Any = Starved(share)
    silence = ChildSilence(child)
    silence.begin(0.0)
    for n in range(1, 10_001):
        child.now_s = 0.01 * n
        passed_s = silence.passed_s(child.now_s)
    # The first half a second is not looked into.
    assert passed_s == pytest.approx(0.5 + (1.0 - share) * 99.5, abs=0.1)
    silence.begin(100.0)
    assert silence.passed_s(100.2) == pytest.approx(0.2)


def busy(statement: str, setup: str = "pass") -> Child:
    """Return a started child that repeats a statement for ever."""
    child = Child("busy", "timeit", b"")
    child.start(("-n", 10**12, "-s", setup, statement), ())
    return child


def test_kernel_reports_how_long_a_process_waited_for_a_processor() -> None:
    """A process waits beside others on its one processor; a stopped process does not wait."""
    cpu = min(os.sched_getaffinity(0))
    children = [busy("pass", f"import os; os.sched_setaffinity(0, [{cpu}])") for _ in range(3)]
    child, other, _ = children
    try:
        wait_until(lambda: child.waited_s > 0.2, 60.0)
        assert child.pid is not None
        os.kill(child.pid, signal.SIGSTOP)
        stat = Path(f"/proc/{child.pid}/stat")
        wait_until(lambda: stat.read_text().rpartition(")")[2].split()[0] == "T")
        before_s, other_s = child.waited_s, other.waited_s
        wait_until(lambda: other.waited_s > other_s + 0.2, 60.0)
        assert child.waited_s == before_s
    finally:
        for each in children:
            each.kill()
    assert child.waited_s == 0.0


@pytest.mark.parametrize(
    ("number", "words"), [(signal.SIGKILL, "SIGKILL"), (signal.SIGRTMIN + 1, "signal 35")]
)
def test_end_names_the_signal_that_killed_the_child(number: int, words: str) -> None:
    child = busy("time.sleep(60.0)", "import time")
    assert child.end == "still running"
    assert child.pid is not None
    os.kill(child.pid, number)
    assert child.wait(60.0)
    assert child.end == f"killed by {words}"
    assert child.pid is None


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_signal_waits_until_the_child_handles_it(tmp_path: Path, number: signal.Signals) -> None:
    """systemd signals all processes of a service, one that is being started too."""
    handled = tmp_path / "handled"
    tell = f"signal.signal({int(number)}, lambda *_: open({str(handled)!r}, 'w').close())"
    receive = "from levid.daemon.host.child_process import receive_signals; receive_signals()"
    child = Child("child", "timeit", b"")
    wait_s = 0.3  # so long it has no handler
    child.start(
        ("-n", 10**12, "-s", f"import signal, time; time.sleep({wait_s}); {tell}; {receive}", ""),
        (),
    )
    try:
        assert child.pid is not None
        os.kill(child.pid, number)
        wait_until(handled.exists, 60.0)
        assert child.running
    finally:
        child.kill()
    assert not signal.pthread_sigmask(signal.SIG_BLOCK, ())  # of this process
