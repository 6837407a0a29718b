"""The frame that benchmarks share: targets, what is left of one that was stopped, its children."""

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

from levid.benchmarks.harness import child_processes, isolated, kept_results, table

GIVE_UP_S = 30.0


def gone(pid: int) -> bool:
    """Return whether a process ends soon."""
    give_up_s = time.monotonic() + GIVE_UP_S
    while time.monotonic() < give_up_s:
        try:
            state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
        except FileNotFoundError:
            return True
        if state == "Z":
            return True
        time.sleep(0.02)
    return False


def shown(monkeypatch, capsys, figures, *options: str) -> tuple[dict, str]:
    """Return what a benchmark of these figures prints as JSON, and what it ends with."""
    monkeypatch.setattr(sys, "argv", ["benchmark", "--json", *options])
    kept = {number: signal.getsignal(number) for number in (signal.SIGTERM, signal.SIGHUP)}
    end = ""
    try:
        table.run("Title", lambda _: figures)
    except (SystemExit, ArithmeticError) as error:
        end = str(error)
    finally:
        for number, handler in kept.items():
            signal.signal(number, handler)
    return json.loads(capsys.readouterr().out), end


def test_targets_are_met_missed_or_open(monkeypatch, capsys) -> None:
    most, least = table.Target(most=1.5), table.Target(least=3)
    figures = [
        table.Figure("good", 1.5, "", "x", target=most),
        table.Figure("bad", 2.0, "", "x", target=least),
        table.Figure("open", 2.0, "", "x", target=table.Target(most=1.5, met=table.Met.UNDECIDED)),
        table.Figure("absent", None, "", "x", "good", most),
        table.Figure("plain", 7.0, "", "x", "absent"),
    ]
    said, end = shown(monkeypatch, capsys, figures)
    assert said["met"] == {"good": 1, "bad": 0, "open": "undecided", "absent": None}
    assert said["figures"]["absent"] is None
    assert "incomplete" not in said
    assert end == ""
    assert shown(monkeypatch, capsys, figures, "--check")[1] == (
        "Title: bad is missed, open is undecided"
    )
    assert shown(monkeypatch, capsys, [figures[0], *figures[3:]], "--check")[1] == ""
    monkeypatch.setenv("COLUMNS", "200")
    monkeypatch.setattr(sys, "argv", ["benchmark"])
    table.run("Title", lambda _: figures)
    assert ">= 3: missed" in capsys.readouterr().out


def test_what_was_measured_before_an_error_is_printed_as_incomplete(monkeypatch, capsys) -> None:

    def measure() -> Iterator[object]:
        yield table.Figure("first", 1.0, "", "x")
        raise ZeroDivisionError("the second")

    said, end = shown(monkeypatch, capsys, measure())
    assert said["figures"] == {"first": 1.0}
    assert said["incomplete"] == "ZeroDivisionError: the second"
    assert end == "the second"


STOPPED = """
import os, signal, sys, time
from levid.benchmarks.harness import table
from levid.benchmarks.harness.child_processes import started

signal.signal(signal.SIGHUP, signal.SIG_DFL)  # the tests may run where nobody hangs up

def measure(quick):
    with started(["sleep", "600"]) as child:
        print(child.pid, file=sys.stderr, flush=True)
        yield table.Figure("first", 1.0, "", "x")
        os.kill(os.getpid(), getattr(signal, sys.argv[2]))
        time.sleep(600)

sys.argv = ["benchmark", "--json"]
"""


@pytest.mark.parametrize("name", ["SIGTERM", "SIGHUP", "SIGKILL"])
def test_a_benchmark_that_is_stopped_leaves_no_process_behind(name: str) -> None:
    code = STOPPED.replace("getattr(signal, sys.argv[2])", f"signal.{name}")
    ended = subprocess.run(
        [sys.executable, "-c", f"{code}\ntable.run('x', measure)"],
        capture_output=True,
        text=True,
        timeout=GIVE_UP_S,
        check=False,
    )
    number = getattr(signal, name)
    assert gone(int(ended.stderr.split()[0]))
    if name == "SIGKILL":
        assert ended.returncode == -number
    else:
        assert ended.returncode == 128 + number
        assert json.loads(ended.stdout)["figures"] == {"first": 1.0}


def test_a_child_that_is_deaf_is_killed() -> None:
    children = child_processes
    code = "import signal, time; signal.signal(15, signal.SIG_IGN); print(1); time.sleep(600)"
    with subprocess.Popen([sys.executable, "-uc", code], stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        process.stdout.readline()
        children.end(process, 0.2)
    assert process.returncode == -signal.SIGKILL


def test_what_a_call_runs_ends_with_it(tmp_path: Path, monkeypatch) -> None:
    told = tmp_path / "pid"
    peer = f"echo $$ > {told}; exec sleep 600"
    outcome = isolated.measure_apart(
        subprocess.run, ["sh", "-c", peer], timeout_s=5.0, memory_bytes=8_000_000_000
    )
    assert outcome.failed == "not done after 5 s"
    assert gone(int(told.read_text()))


def test_the_limit_of_a_call_is_of_address_space(monkeypatch) -> None:
    outcome = isolated.measure_apart(
        bytearray, 10**10, timeout_s=GIVE_UP_S, memory_bytes=2_000_000_000
    )
    assert outcome.failed == "more than 2 GB of address space"
    died = isolated.measure_apart(os.abort, timeout_s=GIVE_UP_S, memory_bytes=2_000_000_000)
    assert died.failed == "killed by SIGABRT"


def test_rounds_that_were_kept_are_carried_on_with(tmp_path: Path) -> None:
    kept, file = kept_results, tmp_path / "rounds.jsonl"
    first = kept.Kept(file)
    first.add({"section": "a", "round": 0})
    first.add({"section": "b", "round": 0})
    with file.open("a") as out:
        out.write('{"section": "a", "rou')  # a stop in the middle of a line
    second = kept.Kept(file)
    assert second.of("a") == [{"section": "a", "round": 0}]
    second.add({"section": "a", "round": 1})
    assert [line["round"] for line in kept.Kept(file).of("a")] == [0, 1]
    second.close()
    third = kept.Kept(file)  # a whole run is not carried on with, nor is it lost
    assert third.of("a") == []
    assert "host" in third.lines[0]
    assert len(list(tmp_path.glob("rounds.*.jsonl"))) == 1


def test_figure_that_was_kept_is_the_same_again() -> None:
    figures = [
        table.Figure("a", 1.5, "us", "takes", "b"),
        table.Figure("b", None, "", "open", None, table.Target(most=1.5, met=table.Met.UNDECIDED)),
        table.Figure("c", 3.0, "", "both ways", None, table.Target(most=4.0, least=-4.0)),
    ]
    again = [table.Figure.of(json.loads(json.dumps(figure.plain))) for figure in figures]
    assert again == figures
    assert [figure.met for figure in again] == [None, table.Met.UNDECIDED, table.Met.YES]
    assert str(figures[2].target) == "-4 .. 4"


def test_other_tables_stand_before_that_of_the_figures(monkeypatch, capsys) -> None:
    """What a benchmark says in a table of its own it need not say in that of the figures."""
    figures = [table.Figure("asked", 1.0, "", "what is asked"), table.Figure("rest", 2.0, "", "")]
    for option in ([], ["--json"]):
        arguments = table.parser("x").parse_args(option)
        monkeypatch.setattr(signal, "signal", lambda *_: None)
        table.show("Title", arguments, lambda: figures, lambda: ["its own"])
        printed = capsys.readouterr().out
        if option:
            assert json.loads(printed)["figures"] == {"asked": 1.0, "rest": 2.0}
        else:
            assert printed.index("its own") < printed.index("what is asked")
            assert "rest" not in printed
            assert "2" not in printed
