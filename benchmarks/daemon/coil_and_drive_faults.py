"""Let amplifiers drive a wrong force and drives not move, in every state; check name and device.

Over CAN FD and serial, with the electronics in their own process, and on loopback. Neither device
nor driver reports these faults: the control cycle has to notice them, by comparing command and
reading. Each must be named in the status and in the flight recording, with the coil or the drive.
Cycles count from the first reading that deviates from the command, by the flight recording. At the
amplifiers, all other coils must be at zero force, and the faulty one at what its defect drives of a
command of zero: no command can take that force away. --quick: 18 faults, otherwise 126 in about 25
minutes.
"""

from __future__ import annotations

import random
import shutil
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from levid.benchmarks.daemon.fault_injection_rig import (
    BUSES,
    ERRORS,
    LOOPBACK,
    NotInjectedError,
    Rig,
    fly_cases,
    wait_for,
)
from levid.benchmarks.harness import benchmark_runner
from levid.benchmarks.harness.benchmark_runner import Figure, Target
from levid.config.rig import RigConfig, load_rig
from levid.daemon.control.feed_forward import feed_forward
from levid.daemon.control.following_limits import beam_follow_m, coil_follow_n
from levid.log.errors import LogError
from levid.log.reader import Log, read_log

WITHIN = 5
"""Cycles from the first reading that deviates to the fault of a coil."""
DRIVE_WITHIN = 10
"""Likewise for a drive: its lag explains some of them."""
_SAID_S, _WRITTEN_S = 10.0, 10.0
_MOVE = {"velocity_m_s": 0.02, "settle_s": 0.5}
REST = ("IDLE", "AFTER_LANDING")
FLIGHT = ("LIFT_OFF", "HOVERING", "EXCITING", "MOVING", "LANDING")
COILS = 9

Draw = random.Random


@dataclass(frozen=True)
class Kind:
    """A kind of fault: its line for a draw and a coil or motor, and the states it is injected in.

    left: force in N that the coil drives at zero command, of the drawn number.
    """

    line: Callable[[Draw, bool], str]
    states: tuple[str, ...]
    left: Callable[[float], float] = lambda _: 0.0

    @property
    def of_a_drive(self) -> bool:
        """Whether a drive is faulty, not a coil."""
        return self.states == ("MOVING",)


def _coil(name: str, *numbers: float, at_rest: tuple[float, ...] = ()) -> Callable[..., str]:
    def line(draw: Draw, rests: bool) -> str:
        choice = draw.choice(at_rest if rests and at_rest else numbers)
        return f"{name} {draw.randrange(COILS)}={choice:g}"

    return line


KINDS = {
    # Hovering takes 7.6 N a coil.
    "stuck": Kind(
        _coil("coil-force", 2.0, 4.0, 12.0, -5.0, at_rest=(7.63, -3.0, 1.2)),
        (*REST, *FLIGHT),
        lambda number: number,
    ),
    "dead": Kind(_coil("coil-gain", 0.0), FLIGHT),
    "half": Kind(_coil("coil-gain", 0.5), FLIGHT),
    "offset": Kind(_coil("coil-offset", 1.5, -2.0, 4.0), (*REST, *FLIGHT), lambda number: number),
    "jam": Kind(lambda draw, _: f"jam {draw.choice(('x1', 'x2', 'phi'))}", ("MOVING",)),
    "slow": Kind(lambda draw, _: f"slow {draw.choice(('x1', 'x2', 'phi'))}", ("MOVING",)),
}
CHECKS = {
    "name": "other fault in the status or in the flight recording",
    "device": "the message does not name the coil or the drive",
    "late": f"a coil later than {WITHIN} cycles, a drive later than {DRIVE_WITHIN}",
    "force": "other coils with force, or the faulty one with another force than its defect's",
    "rest": "not usable after one clear",
    "failed": "trials that did not end",
}


@dataclass(frozen=True)
class Case:
    """One trial: its number determines kind, line, state and delay in it."""

    name: str
    kind: Kind
    line: str
    state: str
    delay_s: float

    def __str__(self) -> str:
        return f"{self.line} in {self.state}"

    @property
    def words(self) -> str:
        """Words of the message that name the device."""
        device = self.line.split()[1].partition("=")[0]
        if not self.kind.of_a_drive:
            return f"coil {device}: commanded"
        return "the rotor is at" if device == "phi" else "the beam is at"


def measure(quick: bool) -> Iterator[Figure]:
    """Run the trials on every backend; yield their figures, also if they are interrupted."""
    trials: list[dict[str, Any]] = []
    buses, asked = (*BUSES, LOOPBACK), 6 if quick else 42
    try:
        for number, bus in enumerate(buses):
            cases = [case_of(bus, number * asked + k) for k in range(asked)]
            fly_cases(bus, cases, partial(attempt, trials))
    finally:
        target = Target(least=len(buses) * asked)
        yield Figure("faults", len(trials), "", "faults injected", target=target)
        for check, label in CHECKS.items():
            count = sum(bool(trial.get(check)) for trial in trials)
            yield Figure(check, count, "", label, target=Target(most=0))
        for name, kind in KINDS.items():
            cycles = [t["cycles"] for t in trials if t["kind"] == name and "cycles" in t]
            most = DRIVE_WITHIN if kind.of_a_drive else WITHIN
            label = f"{name}: most cycles to the fault, of {len(cycles)}"
            yield Figure(
                f"{name}_cycles", max(cycles, default=0), "", label, target=Target(most=most)
            )


def case_of(bus: str, number: int) -> Case:
    """Return the trial of this number, the same in every run."""
    name = list(KINDS)[number % len(KINDS)]
    draw = Draw(f"{bus} {number}")
    state = draw.choice(KINDS[name].states)
    line = KINDS[name].line(draw, state in REST)
    return Case(name, KINDS[name], line, state, draw.uniform(0.0, 0.3))


def attempt(trials: list[dict[str, Any]], rig: Rig, case: Case) -> None:
    """Come to the state, inject the fault and judge what follows; append what is wrong."""
    _come_to(rig, case)
    recorded = set(_recordings(rig))
    rig.say(case.line)
    if case.kind.of_a_drive:  # a move of the rotor takes 0.25 s: the fault begins before it
        # After an earlier trial beam and rotor may be anywhere: both have to move.
        beam_m, rotor_rad = (q["value"] for q in rig.ask("status")["manipulator"])
        goal = {"beam_m": _away(beam_m, 0.03), "rotor_rad": _away(rotor_rad, 0.6)}
        rig.begin("move", move={**goal, **_MOVE})
    trials.append(found := dict[str, Any](kind=case.name))
    name = "DRIVE" if case.kind.of_a_drive else "AMPLIFIER"
    try:
        status = rig.until(lambda s: s["fault"] != "NONE", _SAID_S)
        said = "none" if status is None else status["fault"]
        detail = "" if status is None else status["detail"]
        log = wait_for(lambda: _complete(set(_recordings(rig)) - recorded), _WRITTEN_S)
        in_log = "" if log is None else log.metadata.get("name", "")
        if {said, in_log} != {name}:
            found["name"] = f"expected {name}, found {said} ({detail}), in the log {in_log}"
        if case.words not in detail:
            found["device"] = f"expected '{case.words}', found '{detail}'"
        if log is not None and not found.get("name"):
            found["cycles"] = cycles = _cycles(log, case, load_rig(rig.file))
            if cycles > (DRIVE_WITHIN if case.kind.of_a_drive else WITHIN):
                found["late"] = f"{cycles} cycles"
        found["force"] = _force_problem(rig, case)
        clears = rig.come_to_rest()
        found["rest"] = f"{clears} requests to clear" if clears > 1 else ""
        shutil.rmtree(rig.flight, ignore_errors=True)
    except ERRORS as error:
        found["failed"] = f"{error}; the daemon said: {rig.last_words()}"
        raise
    finally:
        for check in CHECKS:
            if found.get(check):
                print(f"{rig.bus}, {case}: {check}: {found[check]}", file=sys.stderr, flush=True)


def _come_to(rig: Rig, case: Case) -> None:
    """Fly to the state of a case."""
    if case.state == "IDLE":
        if rig.until(lambda s: s["state"] == "IDLE" and s["fault"] == "NONE") is None:
            raise NotInjectedError("the rig is not at rest")
    elif case.state == "AFTER_LANDING":
        rig.lift_off("LEVITATING", 1.0)
        rig.ask("land")
        if rig.until(lambda s: s["state"] == "IDLE" and s["session"] is None) is None:
            raise NotInjectedError("the rig did not land")
    elif case.state == "LIFT_OFF":
        rig.begin_levitating()
        if rig.until(lambda s: s["state"] == "LEVITATING", _SAID_S) is None:
            raise NotInjectedError("no lift-off")
    elif case.state == "MOVING" and case.kind.of_a_drive:
        rig.lift_off("LEVITATING", 1.0)
    else:
        state = "LEVITATING" if case.state == "HOVERING" else case.state
        delay_s = 1.0 + case.delay_s if case.state == "HOVERING" else case.delay_s
        rig.lift_off(state, delay_s)


def _away(at: float, goal: float) -> float:
    """Return the goal or its opposite, whichever is farther."""
    return goal if at < 0.0 else -goal


def _force_problem(rig: Rig, case: Case) -> str:
    """Return what is wrong with the forces at the amplifiers after the fault."""
    if not wait_for(lambda: not any(rig.say("status")["acting_n"]), _SAID_S):
        return "force is still commanded"
    expected = np.zeros(COILS)
    if not case.kind.of_a_drive:
        coil, _, number = case.line.split()[1].partition("=")
        expected[int(coil)] = case.kind.left(float(number))
    driven = np.array(rig.say("status")["driven_n"])
    wrong = np.flatnonzero(np.abs(driven - expected) > 1e-9)
    return f"coils {wrong.tolist()} drive {driven[wrong].tolist()} N" if len(wrong) else ""


def _cycles(log: Log, case: Case, rig: RigConfig) -> int:
    """Return the cycles from the first reading that deviates to the fault, both included."""
    rows = log.rows
    last = int(np.flatnonzero(rows["fault"])[0])
    if not case.kind.of_a_drive:
        coil = int(case.line.split()[1].partition("=")[0])
        reading, command = rows["coil_readback_n"][:, coil], rows["coil_n"][:, coil]
        limit = coil_follow_n(rig)
    elif case.line.endswith("phi"):
        reading, command = rows["rotor_rad"], rows["rotor_ref_rad"]
        limit = rig.limits.rotor_follow_rad
    else:
        reading, command = rows["beam_m"], rows["beam_ref_m"]
        limit = beam_follow_m(rig, feed_forward(rig, 1.0 / rig.rate_hz))
    # A command is read back two cycles later; a cycle more or less is no deviation.
    low, high = (
        edge.reduce([command[3 - k : len(command) - k] for k in (1, 2, 3)], axis=0)
        for edge in (np.minimum, np.maximum)
    )
    off = (reading[3:] > high + limit) | (reading[3:] < low - limit)
    off = np.concatenate([np.zeros(3, bool), off])[: last + 1]
    fine = np.flatnonzero(~off)
    return last - int(fine[-1]) if len(fine) else last + 1


def _recordings(rig: Rig) -> list[Path]:
    return sorted((rig.folder / "faults").glob("*.mcap"))


def _complete(paths: set[Path]) -> Log | None:
    """Return the first complete flight recording, None if there is none yet."""
    for path in sorted(paths):
        try:
            log = read_log(path)
        except LogError:  # it is still being written
            continue
        if log.complete:
            return log
    return None


if __name__ == "__main__":
    benchmark_runner.run("Coils and drives that do not follow", measure)
