"""The frame of the benchmarks: targets, interrupted runs, and processes that end with them."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from levid.benchmarks.harness import benchmark_runner, child_measurement
from levid.benchmarks.harness.benchmark_runner import Figure, Target

TIMEOUT_S = 30.0


def ends(pid: int) -> bool:
    """Return whether a process ends within the timeout."""
    give_up_s = time.monotonic() + TIMEOUT_S
    while time.monotonic() < give_up_s:
        stat = Path(f"/proc/{pid}/stat")
        if not stat.exists() or stat.read_text().rpartition(")")[2].split()[0] == "Z":
            return True
        time.sleep(0.02)
    return False


def figures() -> Iterator[Figure]:
    yield Figure("good", 1.5, "", "x", target=Target(most=1.5))
    yield Figure("bad", 2.0, "", "x", target=Target(least=3))
    yield Figure("absent", None, "", "x", "good", Target(most=1.5))
    raise ZeroDivisionError("the last")


def test_figures_before_an_error_are_printed_with_their_targets(monkeypatch, capsys) -> None:
    monkeypatch.setattr(signal, "signal", lambda *_: None)
    arguments = benchmark_runner.parser("x").parse_args(["--json"])
    with pytest.raises(ZeroDivisionError):
        benchmark_runner.show("Title", arguments, figures)
    assert json.loads(capsys.readouterr().out) == {
        "figures": {"good": 1.5, "bad": 2.0, "absent": None},
        "met": {"good": 1, "bad": 0, "absent": None},
        "incomplete": "ZeroDivisionError: the last",
    }


STOPPED = """
import os, signal, sys, time
from levid.benchmarks.harness import benchmark_runner
from levid.benchmarks.harness.start_and_end_processes import started

def measure(quick):
    with started(["sleep", "600"]) as child:
        print(child.pid, file=sys.stderr, flush=True)
        yield benchmark_runner.Figure("first", 1.0, "", "x")
        os.kill(os.getpid(), signal.NAME)
        time.sleep(600)

sys.argv = ["benchmark", "--json"]
benchmark_runner.run('x', measure)
"""


@pytest.mark.parametrize("name", ["SIGTERM", "SIGKILL"])
def test_stopped_benchmark_leaves_no_process_behind(name: str) -> None:
    command = [sys.executable, "-c", STOPPED.replace("NAME", name)]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=TIMEOUT_S, check=False)
    assert ends(int(ended.stderr.split()[0]))
    if name == "SIGTERM":
        assert json.loads(ended.stdout)["figures"] == {"first": 1.0}


def test_call_is_limited_in_memory_and_a_crash_is_its_outcome() -> None:
    limits = {"timeout_s": TIMEOUT_S, "memory_bytes": 2_000_000_000}
    outcome = child_measurement.measure_apart(bytearray, 10**10, **limits)
    assert outcome.failed == "more than 2 GB of address space"
    assert child_measurement.measure_apart(os.abort, **limits).failed == "killed by SIGABRT"


def test_program_that_a_call_runs_ends_with_the_call(tmp_path: Path) -> None:
    pid_file = tmp_path / "pid"
    program = ["sh", "-c", f"echo $$ > {pid_file}; exec sleep 600"]
    outcome = child_measurement.measure_apart(
        subprocess.run, program, timeout_s=5.0, memory_bytes=1 << 33
    )
    assert outcome.failed == "not done after 5 s"
    assert ends(int(pid_file.read_text()))
