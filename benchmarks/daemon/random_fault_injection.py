"""Inject random faults in flight on CAN FD, serial and loopback; check zero force, names and logs.

One half of the trials is flown on an idle machine, the other beside two busy processes for each
processor; loop and electronics need real-time priority for these. The electronics run in their own
process; on loopback the simulated rig is in the loop and ends with it. Each fault must end the
force and be named correctly. Afterwards the daemon must be usable, every log must open, and a
daemon that has ended must leave no process and no lock. Zero force is required within 3 cycles if
the loop can act, counted from the moment the fault is visible. If the loop is dead or the device
does not receive its commands, the device's own timeout counts. Benchmarks beside this one and tests
check faults that must not end a flight. --quick: 42 faults, otherwise 1,002 in 90 minutes.
"""

from __future__ import annotations

import os
import random
import shutil
import sys
from collections.abc import Callable, Iterator
from contextlib import nullcontext
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from levid.benchmarks.daemon.fault_injection_rig import (
    BUSES,
    ERRORS,
    EXPIRE_CYCLES,
    FLYING,
    HOLDING,
    LOOPBACK,
    RATE_HZ,
    SUPERVISOR_S,
    NotInjectedError,
    Rig,
    fly_cases,
    wait_for,
)
from levid.benchmarks.harness import benchmark_runner
from levid.benchmarks.harness.benchmark_runner import Figure, Target
from levid.benchmarks.harness.start_and_end_processes import busy
from levid.daemon.control.faults import Fault
from levid.daemon.control.states import IN_FLIGHT
from levid.log.errors import LogError
from levid.log.reader import read_log

_BUSY = {"idle": 0, "starved": 2}
"""Busy processes for each processor."""
SOON = 3
"""Cycles with force at most, from the first cycle that the fault affects."""
LAST_S = 1.0
"""Longest part that a log may lack at its end."""
_SKIPPED_MORE = 255
"""A row stores this for 255 skipped periods or more: their number is unknown."""
_WRITTEN_S = 10.0

Line = Callable[[random.Random], str]


@dataclass(frozen=True)
class Kind:
    """A kind of fault.

    fault: its name. line: the command to the electronics, None if a process is killed or stopped.
    own_timeout: the loop is dead or the device does not receive its commands, so only the device
    can end the force. shows: cycles until the fault is visible; deadlines count from there.
    states: states of the flight in which it is injected.
    """

    fault: Fault
    line: Line | None = None
    own_timeout: bool = False
    shows: int = 0
    states: tuple[str, ...] = FLYING

    @property
    def most_cycles(self) -> int:
        """Cycles with force at most."""
        return self.shows + (EXPIRE_CYCLES + 1 if self.own_timeout else SOON)


@dataclass(frozen=True)
class Case:
    """One trial: its number determines kind, command, state of the flight and delay in it."""

    name: str
    kind: Kind
    line: str
    state: str
    delay_s: float

    def __str__(self) -> str:
        return f"{self.line or self.name} in {self.state}"


CHECKS = {
    "force": f"force for more than {SOON} cycles, or than the device's own timeout",
    "name": "other name in the status or in the flight recording",
    "rest": "not usable after one clear, or a process or lock left",
    "logs": "rows missing in flight, or logs that do not open",
    "failed": "trials that did not end",
}


def measure(quick: bool) -> Iterator[Figure]:
    """Run the trials on both buses; yield their figures, also if they are interrupted."""
    trials: dict[str, list[dict[str, str]]] = {}
    asked = 7 if quick else 167
    conditions = [(load, bus) for load in _BUSY for bus in (*BUSES, LOOPBACK)]
    try:
        for number, (load, bus) in enumerate(conditions):
            done = trials.setdefault(f"{bus}_{load}", [])
            cases = [case_of(bus, number * asked + k) for k in range(asked)]
            with busy(_BUSY[load] * (os.cpu_count() or 1)):
                fly_cases(bus, cases, partial(attempt, done))
    finally:
        total = [problems for done in trials.values() for problems in done]
        target = Target(least=len(conditions) * asked)
        yield Figure("faults", len(total), "", "faults injected in flight", target=target)
        for check, label in CHECKS.items():
            count = sum(bool(problems.get(check)) for problems in total)
            yield Figure(check, count, "", label, target=Target(most=0))
        for condition, done in trials.items():
            wrong = sum(any(problems.values()) for problems in done)
            label = f"{condition.replace('_', ', ')}: of {len(done)} trials, with a problem"
            yield Figure(condition, wrong, "", label)


def case_of(bus: str, number: int) -> Case:
    """Return the trial of this number, the same in every run."""
    kinds = _KINDS[bus]
    pack = sorted(kinds)
    random.Random(f"{bus} pack {number // len(pack)}").shuffle(pack)
    name = pack[number % len(pack)]
    kind, draw = kinds[name], random.Random(f"{bus} {number}")
    state, delay_s = draw.choice(kind.states), draw.uniform(0.0, 1.0)
    return Case(name, kind, kind.line(draw) if kind.line else "", state, delay_s)


def attempt(trials: list[dict[str, str]], rig: Rig, case: Case) -> None:
    """Fly, inject the fault, watch the force and come to rest; append the problems by check."""
    status = rig.lift_off(case.state, case.delay_s)
    recorded = _recordings(rig)
    before = rig.say(case.line or "status")
    if not any(before["acting_n"]):
        raise NotInjectedError("no force acts")
    trials.append(problems := dict[str, str]())
    process, _, how = case.name.partition(" ")
    most, name = case.kind.most_cycles, case.kind.fault.name
    try:
        with nullcontext() if case.line else rig.signalled(process, how):
            cycles, problems["force"] = rig.until_zero(before["forced_periods"])
        if not case.line:
            cycles = rig.forced_since_signal()
        if cycles > most:
            problems["force"] = f"expected {most} cycles with force or less, found {cycles}"
        found = wait_for(lambda: _recorded(_recordings(rig) - recorded), _WRITTEN_S)
        runs = rig.daemon.poll() is None
        if runs and rig.until(lambda s: s["fault"] == name, _WRITTEN_S) is None:
            found = rig.ask("status")["fault"]
        problems["name"] = "" if found == name else f"expected {name}, found {found}"
        clears = rig.come_to_rest()
        problems["rest"] = f"{clears} requests to clear" if clears > 1 else ""
        logs = partial(_log_problem, rig.flight, status["cycle"])
        problems["logs"] = "" if wait_for(lambda: not logs(), _WRITTEN_S) else logs()
        shutil.rmtree(rig.flight, ignore_errors=True)
    except ERRORS as error:
        problems["failed"] = f"{error}; the daemon said: {rig.last_words()}"
        raise
    finally:
        for problem in filter(None, problems.values()):
            print(f"{rig.bus}, {case}: {problem}", file=sys.stderr)


def _recordings(rig: Rig) -> set[Path]:
    return set((rig.folder / "faults").glob("*.mcap"))


def _recorded(paths: set[Path]) -> str:
    """Return the fault that a complete flight recording names, empty if there is none yet."""
    for path in paths:
        try:
            log = read_log(path)
        except LogError:  # it is still being written
            continue
        if log.complete:
            return log.metadata.get("name", "")
    return ""


def _log_problem(folder: Path, until: int) -> str:
    """Return what the logs of a flight lack: every cycle in the air, up to cycle `until`."""
    try:
        logs = [read_log(path) for path in sorted(folder.glob("*.mcap"))]
    except LogError as error:
        return str(error)
    if not logs or not all(log.complete for log in logs):
        return f"expected complete logs, found {[log.problem or 'complete' for log in logs]}"
    rows = np.concatenate([log.rows for log in logs])
    flying = np.isin(rows["state"], [int(state) for state in IN_FLIGHT]) & (rows["fault"] == 0)
    rows = rows[flying]  # a dead bus has no rows
    cycles, skipped = (rows[name].astype(np.int64) for name in ("cycle", "skipped"))
    lost = np.maximum(np.diff(cycles) - 1 - skipped[1:], 0)[skipped[1:] < _SKIPPED_MORE].sum()
    if lost:
        return f"{lost} rows are missing"
    tail_s = (until - cycles[-1]) / RATE_HZ
    return f"the last {tail_s:.2f} s are missing" if tail_s > LAST_S else ""


def _one(name: str, *arguments: object) -> Line:
    return lambda draw: f"{name} {draw.choice(arguments)}" if arguments else name


def _size(name: str, least: float, most: float) -> Line:
    return lambda draw: f"{name} {draw.choice((-1, 1)) * draw.uniform(least, most):.3g}"


_FROZEN_SHOWS = 40
"""Equal readings after which a frozen channel is a fault: 26 to 36, of 80 readings' noise."""
_PUSH_SHOWS = 1
"""40 N move 7 kg on the rods beyond 0.85 mm in 17 ms; a cycle is 20 ms."""
_TILT_SHOWS = 3
"""0.55 N m on 195 N m/rad overshoots to 5.6 mrad (limit 4) after half a period of 58 rad/s."""
_SILENCE_SHOWS = round(SUPERVISOR_S * RATE_HZ)
"""A stopped process cannot be distinguished from a slow one until then."""

_PROCESSES = {
    "loop killed": Kind(Fault.LOOP, own_timeout=True),
    "loop stopped": Kind(Fault.LOOP, own_timeout=True),
    "supervisor killed": Kind(Fault.SUPERVISOR),
    "supervisor stopped": Kind(Fault.SUPERVISOR, shows=_SILENCE_SHOWS),
}
_LIMITS = {
    # Limits: beam position, beam speed, platform height, tilt.
    "shift": Kind(Fault.BEAM, _size("shift", 0.15, 0.3)),
    "race": Kind(Fault.VELOCITY, _size("race", 1.5, 3.0)),
    "push": Kind(Fault.GAP, _size("push", 40.0, 80.0), shows=_PUSH_SHOWS, states=HOLDING),
    "tilt": Kind(Fault.POSE, _size("tilt", 0.55, 0.65), shows=_TILT_SHOWS, states=HOLDING),
}
_EVERYWHERE = {
    **_PROCESSES,
    **_LIMITS,
    "drop": Kind(Fault.STALE, _one("drop")),
    "stuck": Kind(Fault.SENSOR, _one("stuck", *range(9))),
    "trip": Kind(Fault.AMPLIFIER, _one("trip", *range(9))),
    "encoder": Kind(Fault.DRIVE, _one("encoder", "x1", "x2", "phi")),
    "nan-coil": Kind(Fault.READING, _one("nan-coil", *range(9))),
}
_ON_A_BUS = {
    **_EVERYWHERE,
    **{name: Kind(Fault.STALE, _one(name)) for name in ("delay", "corrupt", "repeat", "reorder")},
    "drop-setpoints": Kind(Fault.AMPLIFIER, _one("drop-setpoints"), own_timeout=True),
    "frozen": Kind(Fault.SENSOR, _one("frozen", *range(9)), shows=_FROZEN_SHOWS),
    "saturated": Kind(Fault.SENSOR, _one("saturated", *range(9))),
    "skew": Kind(Fault.DRIVE, _size("skew", 0.03, 0.1)),
}
_KINDS = {
    "canfd": {
        **_ON_A_BUS,
        # The driver of the host's controller reports this.
        "bus-off": Kind(Fault.LINK, _one("bus-off"), own_timeout=True),
        # A node that leaves a CAN bus is only silent.
        "disconnect": Kind(Fault.STALE, _one("disconnect"), own_timeout=True),
    },
    "serial": {
        **_ON_A_BUS,
        # The host detects a lost port at once.
        "bus-off": Kind(Fault.STALE, _one("bus-off"), own_timeout=True),
        "disconnect": Kind(Fault.LINK, _one("disconnect"), own_timeout=True),
        "nan-axis": Kind(Fault.READING, _one("nan-axis", "x1", "x2", "phi")),
    },
    LOOPBACK: {
        **_EVERYWHERE,
        "disconnect": Kind(Fault.LINK, _one("disconnect")),
        "nan-axis": Kind(Fault.READING, _one("nan-axis", "x1", "x2", "phi")),
    },
}


if __name__ == "__main__":
    benchmark_runner.run("Faults", measure)
