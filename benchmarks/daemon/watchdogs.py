"""Kill and stop every process in flight: check that the force ends or the platform lands in time.

The daemon flies at 50 Hz on CAN FD and serial, against electronics in their own process. Cycles
with force are counted at the amplifiers, which expire after two cycles without setpoints. Each
process is killed and stopped (SIGSTOP); the loop is also stopped for 0.3 s. One half of the trials
uses a rig that lands without its supervisor, the other half a rig that switches to zero force.
docs/daemon.md lists the deadlines. --quick: 36 trials, otherwise 216 in half an hour.
"""

from __future__ import annotations

import contextlib
import os
import random
import signal
import statistics
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from levid.benchmarks.daemon.fault_flight import (
    LANDING_S,
    Flight,
    NotInjectedError,
    come_to_rest,
    lift_off,
)
from levid.benchmarks.daemon.fault_list import BUSES, FLYING, Case
from levid.benchmarks.daemon.fault_rig import GIVE_UP_S, RATE_HZ, SUPERVISOR_S, Rig
from levid.benchmarks.harness import table
from levid.benchmarks.harness.table import Figure, Target
from levid.daemon.client import DaemonError

GONE = ("land", "zero")
EXPIRE_CYCLES = 2
LOST_CYCLES = EXPIRE_CYCLES + 1
"""Cycles with force at most after the loop's last command."""
SILENT_CYCLES = round(SUPERVISOR_S * RATE_HZ)
SLACK_CYCLES = 5
"""Age of the last heartbeat, and the polling interval of the loop and this program, in cycles."""
HELD_S = 0.3
_RAMP_S, _RELEASE_S = 0.3, 0.5
_WATCHED_S = 1.0
_PROCESSES = ("loop", "supervisor", "recorder", "planner")
DEEDS = (*(f"{name} {how}" for name in _PROCESSES for how in ("killed", "stopped")), "loop held up")
_EACH = 6


def measure(quick: bool) -> Iterator[Figure]:
    """Run all trials; yield their figures, also if they are interrupted."""
    cycles: dict[str, list[int]] = defaultdict(list)
    wrong: list[str] = []
    trials = 0
    due: list[tuple[str, int]] = []
    try:
        for bus in BUSES:
            for gone in GONE:
                due = [(deed, n) for n in range(1 if quick else _EACH) for deed in DEEDS]
                trials += len(due)
                while due:  # a failed trial needs a new rig
                    _fly(bus, gone, due, cycles, wrong)
    finally:
        yield Figure("trials", trials - len(due), "", "kills and stops in flight")
        yield Figure("wrong", len(wrong), "", "outside the deadlines", target=Target(most=0))
        for deed, counts in sorted(cycles.items()):
            if not counts:  # the flight had to go on
                continue
            key = deed.replace(" ", "_").replace(",", "")
            middle = statistics.median(counts)
            yield Figure(f"{key}_median", middle, "cycles", f"{deed}: with force, median")
            yield Figure(f"{key}_most", max(counts), "cycles", f"{deed}: at most")


def _fly(
    bus: str, gone: str, due: list[tuple[str, int]], cycles: dict[str, list[int]], wrong: list[str]
) -> None:
    """Run trials on one rig and remove them from the list, until it is empty or one fails."""
    with (
        tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as name,
        contextlib.closing(Rig(bus, Path(name), **rig_keys(gone))) as rig,
    ):
        while due:
            deed, number = due[0]
            draw = random.Random(f"{bus} {gone} {deed} {number}")
            state, delay_s = draw.choice(FLYING), draw.uniform(0.0, 0.5)
            what = f"{bus}, {gone}: {deed} in {state}"
            print(what, end="        \r", file=sys.stderr)
            try:
                flight = lift_off(rig, Case(bus, number, deed, "", state, delay_s), rig.folder)
            except NotInjectedError as error:
                print(f"{what}: repeated: {error}", file=sys.stderr)
                come_to_rest(rig)
                continue
            due.pop(0)
            problem, failed = "", False
            key = f"{deed}, {gone}" if deed.startswith("supervisor") else deed
            try:
                problem = attempt(rig, flight, deed, gone, state, cycles[key])
                come_to_rest(rig)
            except (RuntimeError, OSError, DaemonError) as error:
                problem, failed = str(error), True
            finally:
                flight.hang_up()
            if problem:
                wrong.append(problem)
                print(f"{what}: {problem}", file=sys.stderr)
            if failed:
                return


def rig_keys(gone: str) -> dict[str, dict[str, Any]]:
    """Return the keys of the rig that differ from the rig of the fault benchmark."""
    return {
        "service": {"supervisor_gone": gone},
        "amplifiers": {"expire_cycles": EXPIRE_CYCLES},
        "limits": {"stall_s": None},
    }


def attempt(rig: Rig, flight: Flight, deed: str, gone: str, state: str, cycles: list[int]) -> str:
    """Kill or stop a process and watch the force; return the problem, empty if there is none.

    The number of cycles with force is appended to `cycles`.
    """
    name, _, how = deed.partition(" ")
    pid = flight.status["pids"][name]
    before = rig.forced_periods()
    os.kill(pid, signal.SIGKILL if how == "killed" else signal.SIGSTOP)
    try:
        if how == "held up":
            time.sleep(HELD_S)
            os.kill(pid, signal.SIGCONT)
        if name in ("recorder", "planner"):
            return _goes_on(rig, state)
        return _ends(rig, before, _deadline(deed, gone, state), cycles)
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, signal.SIGCONT)
        if deed == "supervisor killed" and rig.daemon is not None:
            rig.daemon.wait(GIVE_UP_S)


def _ends(rig: Rig, before: int, deadline: tuple[int, int], cycles: list[int]) -> str:
    """Watch the force until it ends and stays zero; compare its duration with the deadline."""
    give_up_s = time.monotonic() + GIVE_UP_S
    while rig.forces():
        if time.monotonic() > give_up_s:
            return f"force after {GIVE_UP_S:g} s"
        time.sleep(0.005)
    ended = rig.forced_periods()
    time.sleep(_WATCHED_S)
    if again := rig.forced_periods() - ended:
        return f"force acts again, for {again} cycles"
    cycles.append(ended - before)
    least, most = deadline
    if not least <= cycles[-1] <= most:
        return f"expected {least} to {most} cycles with force, found {cycles[-1]}"
    return ""


def _deadline(deed: str, gone: str, state: str) -> tuple[int, int]:
    """Return the least and the most cycles with force after a kill or stop."""
    if deed.startswith("loop"):
        return 0, LOST_CYCLES
    noticed = SILENT_CYCLES if deed.endswith("stopped") else 0
    if gone == "zero":
        return 0, noticed + SLACK_CYCLES
    ramp_s = LANDING_S if state == "LANDING" else _RAMP_S
    landing = round((ramp_s + _RELEASE_S) * RATE_HZ)
    # A landing in progress continues from any point; its last cycles command no force.
    return 0 if state == "LANDING" else landing - SLACK_CYCLES, noticed + landing + SLACK_CYCLES


def _goes_on(rig: Rig, state: str) -> str:
    """Fly on for a while and land; return the problem, empty if there is none."""
    time.sleep(_WATCHED_S)
    status = rig.ask("status")
    if status["fault"] != "NONE" or (state != "LANDING" and status["state"] == "IDLE"):
        return f"the flight ended: {status['fault']}: {status['detail']}"
    rig.ask("land")
    status = rig.until(lambda s: s["state"] in ("IDLE", "FAULT")) or {}
    return "" if status.get("fault") == "NONE" else f"landed in {status.get('fault')}"


if __name__ == "__main__":
    table.run("Watchdogs", measure)
