"""Kill and stop every process in flight: check that the force ends or the platform lands in time.

The daemon flies at 50 Hz on CAN FD and serial, against electronics in their own process. Cycles
with force are counted at the amplifiers, which expire after two cycles without setpoints. Each
process is killed and stopped (SIGSTOP); the loop is also stopped for 0.3 s. One half of the trials
uses a rig that lands without its supervisor, the other half a rig that switches to zero force.
docs/daemon.md lists the deadlines. --quick: 36 trials, otherwise 216 in half an hour.
"""

from __future__ import annotations

import os
import random
import signal
import statistics
import sys
import time
from collections import defaultdict
from collections.abc import Iterator
from functools import partial
from typing import Any

from levid.benchmarks.daemon.fault_injection_rig import (
    BUSES,
    ERRORS,
    FLYING,
    LANDING_S,
    RAMP_S,
    RATE_HZ,
    SUPERVISOR_S,
    WATCHED_S,
    Rig,
    fly_cases,
)
from levid.benchmarks.harness import benchmark_runner
from levid.benchmarks.harness.benchmark_runner import Figure, Target

EXPIRE_CYCLES = 2
LOST_CYCLES = EXPIRE_CYCLES + 1
"""Cycles with force at most after the loop's last command."""
SILENT_CYCLES = round(SUPERVISOR_S * RATE_HZ)
SLACK_CYCLES = 5
"""Age of the last heartbeat, and the polling interval of the loop and this program, in cycles."""
HELD_S = 0.3
_RELEASE_S = 0.5
_PROCESSES = ("loop", "supervisor", "recorder", "planner")
DEEDS = (*(f"{name} {how}" for name in _PROCESSES for how in ("killed", "stopped")), "loop held up")


def measure(quick: bool) -> Iterator[Figure]:
    """Run all trials; yield their figures, also if they are interrupted."""
    cycles: dict[str, list[int]] = defaultdict(list)
    done: list[str] = []
    due = [(deed, n) for n in range(1 if quick else 6) for deed in DEEDS]
    try:
        for bus in BUSES:
            for gone in ("land", "zero"):
                fly_cases(bus, due, partial(_attempt, gone, cycles, done), **rig_keys(gone))
    finally:
        asked = Target(least=len(BUSES) * 2 * len(due))
        wrong = sum(bool(problem) for problem in done)
        yield Figure("trials", len(done), "", "kills and stops in flight", target=asked)
        yield Figure("wrong", wrong, "", "outside the deadlines", target=Target(most=0))
        for deed, counts in sorted(cycles.items()):
            key = deed.replace(" ", "_").replace(",", "")
            middle = statistics.median(counts)
            yield Figure(f"{key}_median", middle, "cycles", f"{deed}: with force, median")
            yield Figure(f"{key}_most", max(counts), "cycles", f"{deed}: at most")


def _attempt(
    gone: str, cycles: dict[str, list[int]], done: list[str], rig: Rig, case: tuple[str, int]
) -> None:
    """Run a trial, and append its problem, empty if there is none."""
    deed, number = case
    draw = random.Random(f"{rig.bus} {gone} {deed} {number}")
    state, delay_s = draw.choice(FLYING), draw.uniform(0.0, 0.5)
    rig.lift_off(state, delay_s)
    counts, problem = list[int](), ""
    try:
        problem = attempt(rig, deed, gone, state, counts)
        rig.come_to_rest()
    except ERRORS as error:
        problem = str(error)
        raise
    finally:
        done.append(problem)
        if counts:  # else the flight had to go on
            cycles[f"{deed}, {gone}" if deed.startswith("supervisor") else deed] += counts
        if problem:
            print(f"{rig.bus}, {gone}: {deed} in {state}: {problem}", file=sys.stderr)


def rig_keys(gone: str) -> dict[str, dict[str, Any]]:
    """Return the keys of the rig that differ from the rig of the fault benchmark."""
    return {
        "service": {"supervisor_gone": gone},
        "amplifiers": {"expire_cycles": EXPIRE_CYCLES},
        "limits": {"stall_s": None},
    }


def attempt(rig: Rig, deed: str, gone: str, state: str, cycles: list[int]) -> str:
    """Kill or stop a process and watch the force; return the problem, empty if there is none.

    The number of cycles with force is appended to `cycles`.
    """
    name, _, how = deed.partition(" ")
    before = rig.forced_periods()
    with rig.signalled(name, how) as pid:
        if how == "held up":
            time.sleep(HELD_S)
            os.kill(pid, signal.SIGCONT)
        if name in ("recorder", "planner"):
            return _goes_on(rig, state)
        forced, problem = rig.until_zero(before)
    if problem:
        return problem
    cycles.append(forced)
    least, most = _deadline(deed, gone, state)
    if not least <= forced <= most:
        return f"expected {least} to {most} cycles with force, found {forced}"
    return ""


def _deadline(deed: str, gone: str, state: str) -> tuple[int, int]:
    """Return the least and the most cycles with force after a kill or stop."""
    if deed.startswith("loop"):
        return 0, LOST_CYCLES
    noticed = SILENT_CYCLES if deed.endswith("stopped") else 0
    if gone == "zero":
        return 0, noticed + SLACK_CYCLES
    ramp_s = LANDING_S if state == "LANDING" else RAMP_S
    landing = round((ramp_s + _RELEASE_S) * RATE_HZ)
    # A landing in progress continues from any point; its last cycles command no force.
    return 0 if state == "LANDING" else landing - SLACK_CYCLES, noticed + landing + SLACK_CYCLES


def _goes_on(rig: Rig, state: str) -> str:
    """Fly on for a while and land; return the problem, empty if there is none."""
    time.sleep(WATCHED_S)
    status = rig.ask("status")
    if status["fault"] != "NONE" or (state != "LANDING" and status["state"] == "IDLE"):
        return f"the flight ended: {status['fault']}: {status['detail']}"
    rig.ask("land")
    status = rig.until(lambda s: s["state"] in ("IDLE", "FAULT")) or {}
    return "" if status.get("fault") == "NONE" else f"landed in {status.get('fault')}"


if __name__ == "__main__":
    benchmark_runner.run("Watchdogs", measure)
