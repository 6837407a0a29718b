"""Kills and stops of every process in flight: does the force end, or the platform land, in time?

On CAN FD and serial, against electronics in a process of their own, at 50 Hz: a kernel stalls for
less than a cycle of 20 ms. Force is counted at the electronics, amplifier by amplifier, from the
moment of the deed on. Amplifiers expire after two cycles without setpoints. Each process is killed
and stopped (SIGSTOP), the loop also stopped for 0.3 s; half of the trials on a rig that lands
without its supervisor, half on one that goes to zero force. docs/daemon.md has the table of what is
promised. --quick: 36 trials; else 216, in half an hour; --bus flies those of one bus.
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
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from levid.benchmarks.daemon.fault_flight import (
    _LANDING_S,
    Flight,
    NotInjectedError,
    come_to_rest,
    lift_off,
)
from levid.benchmarks.daemon.fault_list import FLYING, Case
from levid.benchmarks.daemon.fault_rig import GIVE_UP_S, RATE_HZ, SUPERVISOR_S, Rig
from levid.benchmarks.harness import table
from levid.benchmarks.harness.table import Figure, Target
from levid.daemon.client import DaemonError

BUSES, GONE = ("canfd", "serial"), ("land", "zero")
EXPIRE_CYCLES = 2
LOST_CYCLES = EXPIRE_CYCLES + 1
"""Cycles with force after a loop's last command, at most."""
SILENT_CYCLES = round(SUPERVISOR_S * RATE_HZ)
SLACK_CYCLES = 5
"""Cycles that the last beat may be old, and that the loop and this may take to look."""
_RAMP_S, _RELEASE_S = 0.3, 0.5
_HELD_S = 0.3
_WATCHED_S = 1.0
_PROCESSES = ("loop", "supervisor", "recorder", "planner")
DEEDS = (*(f"{name} {how}" for name in _PROCESSES for how in ("killed", "stopped")), "loop held up")
_EACH = 6


@dataclass
class Outcomes:
    """What came of the trials of one deed: cycles with force after it; what was wrong, in words."""

    cycles: list[int] = field(default_factory=list)
    wrong: list[str] = field(default_factory=list)
    trials: int = 0


def measure(quick: bool, buses: Sequence[str] = BUSES) -> Iterator[Figure]:
    found: dict[str, Outcomes] = defaultdict(Outcomes)
    each = 1 if quick else _EACH
    try:
        for bus in buses:
            for gone in GONE:
                trials = [(deed, number) for number in range(each) for deed in DEEDS]
                while trials:  # the rig is made anew where one cannot go on
                    _fly(bus, gone, trials, found)
    finally:
        yield from _figures(found)


def _fly(bus: str, gone: str, trials: list[tuple[str, int]], found: dict[str, Outcomes]) -> None:
    """Fly trials on one rig, and take them off the list, until none is left or one fails."""
    with (
        tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as name,
        contextlib.closing(Rig(bus, Path(name), **rig_keys(gone))) as rig,
    ):
        while trials:
            deed, number = trials[0]
            draw = random.Random(f"{bus} {gone} {deed} {number}")
            state, delay_s = draw.choice(FLYING), draw.uniform(0.0, 0.5)
            outcomes = found[f"{deed}, {gone}" if deed.startswith("supervisor") else deed]
            print(f"{bus}, {gone}: {deed} in {state}", end="        \r", file=sys.stderr)
            try:
                flight = lift_off(rig, Case(bus, number, deed, "", state, delay_s), rig.folder)
            except NotInjectedError as error:
                print(f"tried again: {error}", file=sys.stderr)
                come_to_rest(rig)
                continue
            trials.pop(0)
            outcomes.trials += 1
            try:
                wrong = attempt(rig, flight, deed, gone, state, outcomes)
                come_to_rest(rig)
            except (RuntimeError, OSError, DaemonError) as error:
                outcomes.wrong.append(f"{bus}: {state}: {error}")
                return
            finally:
                flight.hang_up()
            if wrong:
                outcomes.wrong.append(f"{bus}: {state}: {wrong}")


def rig_keys(gone: str) -> dict[str, dict[str, Any]]:
    """Return the keys of the rig that are not those of other faults."""
    return {
        "service": {"supervisor_gone": gone},
        "amplifiers": {"expire_cycles": EXPIRE_CYCLES},
        "limits": {"stall_s": None},
    }


def attempt(rig: Rig, flight: Flight, deed: str, gone: str, state: str, outcomes: Outcomes) -> str:
    """Do it, watch the force, and return what is not as promised, empty for nothing."""
    name, _, how = deed.partition(" ")
    pid = flight.status["pids"][name]
    before = rig.forced_periods()
    os.kill(pid, signal.SIGKILL if how == "killed" else signal.SIGSTOP)
    try:
        if how == "held up":
            time.sleep(_HELD_S)
            os.kill(pid, signal.SIGCONT)
        if name in ("recorder", "planner"):
            return _goes_on(rig, state)
        return _ends(rig, deed, gone, state, outcomes, before)
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, signal.SIGCONT)
        if deed == "supervisor killed" and rig.daemon is not None:
            rig.daemon.wait(GIVE_UP_S)


def _ends(rig: Rig, deed: str, gone: str, state: str, outcomes: Outcomes, before: int) -> str:
    """Watch the force until it ends; hold that against what is promised."""
    begun_s = time.monotonic()
    while rig.forces():
        if time.monotonic() - begun_s > GIVE_UP_S:
            return f"force after {GIVE_UP_S:g} s"
        time.sleep(0.005)
    cycles = (ended := rig.forced_periods()) - before
    time.sleep(_WATCHED_S)
    if (again := rig.forced_periods() - ended) > 0:
        return f"force acts again, for {again} cycles"
    outcomes.cycles.append(cycles)
    least, most = _promised(deed, gone, state)
    if not least <= cycles <= most:
        return f"expected {least} to {most} cycles with force, found {cycles}"
    return ""


def _promised(deed: str, gone: str, state: str) -> tuple[int, int]:
    """Return how many cycles with force there may be after a deed, at least and at most."""
    if deed.startswith("loop"):
        return 0, LOST_CYCLES
    ramp_s = _LANDING_S if state == "LANDING" else _RAMP_S
    landing = round((ramp_s + _RELEASE_S) * RATE_HZ)
    noticed = SILENT_CYCLES if deed.endswith("stopped") else 0
    if gone == "zero":
        return 0, noticed + SLACK_CYCLES
    # A landing that is being flown goes on, from wherever it is; the last cycles ask for nothing.
    return 0 if state == "LANDING" else landing - SLACK_CYCLES, noticed + landing + SLACK_CYCLES


def _goes_on(rig: Rig, state: str) -> str:
    """Fly on for a while, and land."""
    time.sleep(_WATCHED_S)
    status = rig.ask("status")
    if status["fault"] != "NONE":
        return f"the flight ended in {status['fault']}: {status['detail']}"
    if state != "LANDING" and status["state"] == "IDLE":
        return "the flight ended"
    rig.ask("land")
    status = rig.until(lambda s: s["state"] in ("IDLE", "FAULT")) or {}
    return "" if status.get("fault") == "NONE" else f"landed in {status.get('fault')}"


def _figures(found: dict[str, Outcomes]) -> Iterator[Figure]:
    for deed, outcomes in sorted(found.items()):
        for wrong in outcomes.wrong:
            print(f"{deed}: {wrong}", file=sys.stderr)
    trials, wrong = (
        sum(len(o.wrong) if what else o.trials for o in found.values()) for what in (False, True)
    )
    yield Figure("rate_hz", RATE_HZ, "Hz", "flown at")
    yield Figure("expire_cycles", EXPIRE_CYCLES, "", "cycles until amplifiers expire")
    yield Figure("trials", trials, "", "kills and stops in flight")
    yield Figure("wrong", wrong, "", "not as the table promises", target=Target(most=0))
    for deed, outcomes in sorted(found.items()):
        key = deed.replace(" ", "_").replace(",", "")
        if outcomes.cycles:
            middle = statistics.median(outcomes.cycles)
            yield Figure(f"{key}_median", middle, "cycles", f"{deed}: with force, median")
            yield Figure(f"{key}_most", max(outcomes.cycles), "cycles", f"{deed}: at most")
        yield Figure(f"{key}_trials", outcomes.trials, "", f"{deed}: trials")


def main() -> None:
    options = table.parser(__doc__ or "")
    options.add_argument("--bus", choices=BUSES, action="append", help="one bus alone")
    arguments = options.parse_args()
    table.show("Watchdogs", arguments, lambda: measure(arguments.quick, arguments.bus or BUSES))


if __name__ == "__main__":
    main()
