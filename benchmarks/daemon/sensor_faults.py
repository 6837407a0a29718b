"""Make sensors err in every phase of a flight: the right fault, the right sensor, and how soon.

Most flights are in virtual time on loopback at 1 kHz, on two simulated rigs, where the true gap is
known. The others are flown by the daemon at 50 Hz on CAN FD, serial and loopback, with the
electronics in another process; there the force at the amplifiers is counted by these. Readings
that stand still, a sensor that is off at once, drifts or errs at times must be the fault SENSOR
with the sensor's number. A gain 3 % off and spikes of one cycle must be none. Detection counts from
the first wrong reading. --quick: 12 virtual flights and 3 of the daemon; else 120 and 36.
"""

from __future__ import annotations

import itertools
import random
import re
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial

from levid.benchmarks.daemon.fault_injection_rig import (
    BUSES,
    ERRORS,
    LOOPBACK,
    NotInjectedError,
    Rig,
    fly_cases,
)
from levid.benchmarks.daemon.spoilt_flight import PHASES, fly
from levid.benchmarks.harness import benchmark_runner
from levid.benchmarks.harness.benchmark_runner import Figure, Target
from levid.config.shipped import shipped

SOON = 3
"""Cycles with force at most after the fault was found."""
_SIMS = ("nominal", "rig")
_STANDS, _OFF, _SOUND = "repeats? (its|their) reading", "off the plane|jumped", ""


@dataclass(frozen=True)
class Kind:
    """A kind of error: line with a place for the sensors, how many, words of its fault, cycles.

    words: empty if it must be no fault. most: cycles to detection at 1 kHz and at 50 Hz.
    """

    line: str
    sensors: int
    words: str
    most: tuple[int, int]


KINDS = {
    "all_frozen": Kind("frozen all", 9, "all 9 sensors repeat", (26, 40)),
    "one_frozen": Kind("frozen {}", 1, _STANDS, (26, 40)),
    "two_frozen": Kind("frozen {}", 2, _STANDS, (30, 44)),
    "off_0.15_mm": Kind("off {} 0.00015", 1, _OFF, (115, 8)),
    "off_0.2_mm": Kind("off {} 0.0002", 1, _OFF, (72, 6)),
    "off_0.5_mm": Kind("off {} -0.0005", 1, _OFF, (24, 3)),
    # 0.4 mm/s: 0.1 mm after 0.25 s, and the average's delay of 0.1 s; the offsets of the sensors of
    # `rig`, some micrometres, make it 0.01 s more.
    "drift": Kind("drift {} 0.0004", 1, _OFF, (360, 20)),
    "intermittent": Kind("intermittent {} 0.0003", 1, _OFF, (45, 5)),
    "gain_3_percent": Kind("gain {} 1.03", 1, _SOUND, (0, 0)),
    "spikes": Kind("spike {} 0.0001", 1, _SOUND, (0, 0)),
}
_OF_THE_DAEMON = {
    "all_frozen": "frozen all", "one_frozen": "frozen {}", "off_0.2_mm": "off {} 0.0002",
    "off_0.5_mm": "off {} 0.0005",
}  # fmt: skip
_DAEMON_STATES = ("LEVITATING", "EXCITING", "MOVING")


@dataclass(frozen=True)
class Outcome:
    """One trial: its kind, whether fault and sensor are right, cycles, true gap in mm, force in N.

    Values that a trial does not have are None.
    """

    kind: str
    named: bool
    device: bool
    cycles: int | None = None
    gap_mm: float | None = None
    later_n: float | None = None


def measure(quick: bool) -> Iterator[Figure]:
    """Fly all trials; yield their counts and, by kind, the slowest detection."""
    flown = list(virtual_trials(12 if quick else 120))
    yield from _counts("virtual", flown)
    for kind, what in KINDS.items():
        one = [o for o in flown if o.kind == kind and o.cycles]
        if what.words and one:
            cycles, gap = max(o.cycles or 0 for o in one), max(o.gap_mm or 0.0 for o in one)
            target = Target(most=what.most[0])
            yield Figure(f"{kind}_cycles", cycles, "", f"{kind}: cycles to detection", None, target)
            yield Figure(f"{kind}_gap_mm", gap, "mm", f"{kind}: largest true gap in hover by then")
    left = max((o.later_n for o in flown if o.later_n is not None), default=None)
    yield Figure(
        "later_n", left, "N", "most force read back after a fault", None, Target(most=0.05)
    )
    for number, bus in enumerate((*BUSES, LOOPBACK)):
        done: list[Outcome] = []
        cases = [daemon_case(number, k) for k in range(1 if quick else 12)]
        fly_cases(bus, cases, partial(attempt, done))
        yield from _counts(bus, done)
        most = max((o.cycles for o in done if o.cycles is not None), default=None)
        yield Figure(f"{bus}_cycles", most, "", f"{bus}: most cycles with force after the error")


def _counts(where: str, done: list[Outcome]) -> Iterator[Figure]:
    faults = sum(bool(KINDS[o.kind].words) for o in done)
    yield Figure(f"{where}_faults", faults, "", f"{where}: faults injected")
    yield Figure(f"{where}_sound", len(done) - faults, "", f"{where}: errors that are no fault")
    for key, label in (("named", "not the expected fault"), ("device", "other sensors named")):
        wrong = sum(not getattr(o, key) for o in done)
        target = Target(most=0)
        yield Figure(f"{where}_wrong_{key}", wrong, "", f"{where}: {label}", None, target)


def virtual_trials(count: int) -> Iterator[Outcome]:
    """Fly trials in virtual time, the same in every run."""
    cases = list(itertools.product(KINDS, PHASES[1:], _SIMS, range(3)))
    random.Random("sensors").shuffle(cases)
    for number, (kind, phase, sim, _) in enumerate(cases[:count]):
        draw = random.Random(f"{kind} {number}")
        line, sensors = _line(kind, KINDS[kind].line, draw)
        found = fly(line, phase, draw.random() * 0.8, sim=shipped(f"sims/{sim}.yaml"))
        what = KINDS[kind]
        named = found.fault == ("SENSOR" if what.words else "")
        device = bool(re.search(what.words, found.text)) and _names(found.text, sensors)
        if not (named and device):
            print(f"{line} in {phase} on {sim}: {found}", file=sys.stderr)
        hovers = phase == "hover"
        yield Outcome(
            kind, named, device, found.cycles or None, 1e3 * found.gap_m if hovers else 0.0,
            found.later_n,
        )  # fmt: skip


def daemon_case(bus: int, number: int) -> tuple[str, str, list[int], str]:
    """Return kind, line, sensors and state of a trial of the daemon."""
    kind = list(_OF_THE_DAEMON)[(number + bus) % len(_OF_THE_DAEMON)]
    draw = random.Random(f"daemon {bus} {number}")
    line, sensors = _line(kind, _OF_THE_DAEMON[kind], draw)
    return kind, line, sensors, _DAEMON_STATES[number % len(_DAEMON_STATES)]


def attempt(done: list[Outcome], rig: Rig, case: tuple[str, str, list[int], str]) -> None:
    """Fly with the daemon, inject the error, and append what the daemon said."""
    kind, line, sensors, state = case
    rig.lift_off(state, random.Random(line + state).uniform(0.5, 1.0))
    before = rig.say(line)
    if not any(before["acting_n"]):
        raise NotInjectedError("no force acts")
    try:
        cycles, problem = rig.until_zero(before["forced_periods"])
        status = rig.until(lambda s: s["fault"] != "NONE", 10.0) or rig.ask("status")
        named = status["fault"] == "SENSOR" and not problem
        text = status["detail"]
        device = bool(re.search(KINDS[kind].words, text)) and _names(text, sensors)
        within = cycles <= KINDS[kind].most[1] + SOON
        if not (named and device and within):
            print(f"{rig.bus}, {line}: {cycles} cycles, {status['fault']}: {text}", file=sys.stderr)
        done.append(Outcome(kind, named and within, device, cycles))
        rig.come_to_rest()
    except ERRORS as error:
        print(f"{rig.bus}, {line}: {error}; {rig.last_words()}", file=sys.stderr)
        raise


def _line(kind: str, line: str, draw: random.Random) -> tuple[str, list[int]]:
    what = KINDS[kind]
    sensors = sorted(draw.sample(range(9), what.sensors))
    return line.format(",".join(map(str, sensors))), sensors


def _names(text: str, sensors: list[int]) -> bool:
    """Return whether a fault's text names these sensors and no others; no text names none."""
    if not text or len(sensors) == 9:
        return True
    named = re.match(r"sensors? ([0-9, and]+)", text)
    return named is not None and [int(n) for n in re.findall(r"\d+", named[1])] == sensors


if __name__ == "__main__":
    benchmark_runner.run("Errors of sensors", measure)
