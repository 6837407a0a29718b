"""The faults of trials: what each does, when force has to be zero, what the daemon may call it.

A trial is drawn from its number alone: the kind, as from a pack of cards that is shuffled anew when
it is used up; its channel or size; in which state of the flight and how long after it began. What a
machine cannot do is drawn all the same, and then left out.
"""

from __future__ import annotations

import random
from collections.abc import Callable
from dataclasses import dataclass

from levid.benchmarks.daemon.fault_rig import EXPIRE_CYCLES, RATE_HZ, SUPERVISOR_S
from levid.daemon.control.faults import Fault

BUSES = ("canfd", "serial")
SOON = 3
"""Cycles in which force acts, at most, from the first one on that the fault touches."""
HOLDING = ("LEVITATING", "EXCITING", "MOVING")
FLYING = (*HOLDING, "LANDING")
LAST = ""
"""The kind of the trial after the last one, which only has to fly."""

Draw = random.Random
Line = Callable[[Draw], str]


@dataclass(frozen=True)
class Kind:
    """A kind of fault.

    named: what the daemon may call it, empty for what must not disturb. line: what the electronics
    are told, if it is theirs. own_timeout: the loop is dead or the device hears nothing of it, so
    that only the device can end the force. shows: cycles until the limit is exceeded, or it can be
    known at all; what is promised counts from there. states: in which it may come.
    """

    named: frozenset[str] = frozenset()
    line: Line | None = None
    own_timeout: bool = False
    shows: int = 0
    states: tuple[str, ...] = FLYING

    @property
    def must_stop(self) -> bool:
        """Whether force has to end."""
        return bool(self.named)

    @property
    def most_cycles(self) -> int:
        """Cycles with force that were promised at most."""
        return self.shows + (EXPIRE_CYCLES + 1 if self.own_timeout else SOON)


@dataclass(frozen=True)
class Case:
    """One trial as it was drawn."""

    bus: str
    number: int
    kind: str
    line: str
    state: str
    delay_s: float


def case_of(bus: str, number: int, last: bool = False) -> Case:
    """Return the trial of this number, the same in every run."""
    if last:
        return Case(bus, number, LAST, "", "LEVITATING", 0.0)
    pack = sorted(kinds(bus))
    Draw(f"{bus} pack {number // len(pack)}").shuffle(pack)
    name = pack[number % len(pack)]
    kind, draw = kinds(bus)[name], Draw(f"{bus} {number}")
    state, delay_s = draw.choice(kind.states), draw.uniform(0.0, 1.0)
    return Case(bus, number, name, kind.line(draw) if kind.line else "", state, delay_s)


def kinds(bus: str) -> dict[str, Kind]:
    """Return every kind of fault on this bus by its name."""
    return _EVERYWHERE | (_SERIAL if bus == "serial" else _CAN)


def untested() -> list[str]:
    """Return the names of faults that no trial asks for."""
    asked = {name for bus in BUSES for kind in kinds(bus).values() for name in kind.named}
    return [fault.name for fault in Fault if fault and fault.name not in asked]


def _plain(name: str) -> Line:
    return lambda _: name


def _channel(name: str) -> Line:
    return lambda draw: f"{name} {draw.randrange(9)}"


def _axis(name: str) -> Line:
    return lambda draw: f"{name} {draw.choice(('x1', 'x2', 'phi'))}"


def _size(name: str, least: float, most: float) -> Line:
    return lambda draw: f"{name} {draw.choice((-1, 1)) * draw.uniform(least, most):.3g}"


def _one(fault: Fault) -> frozenset[str]:
    return frozenset({fault.name})


_FROZEN_SHOWS = 20
"""Repeats that no sound channel makes, by the driver; where it is far off the others, three do."""
_PUSH_SHOWS = 1
"""40 N take 7 kg on their rods beyond 0.85 mm in 17 ms, of 20 that a cycle takes."""
_TILT_SHOWS = 3
"""The swing that a torque sets off, to twice what it holds in the end (5.6 mrad of 4 that it may,
0.55 N m on 195 N m/rad), is at its peak after half a period of 58 rad/s: 54 ms."""
_HEAT_SHOWS = 67
"""A coil that was cold, with a time constant of 1 s, on its way from nothing to 7.8 N at rest and
7 N rms (together 10.5) passes 8.8 after 1.22 s; the excitation fades in for 0.1 s."""

_SILENCE_SHOWS = round(SUPERVISOR_S * RATE_HZ)
"""One that is stopped and one that is slow look alike until then."""

_EVERYWHERE = {
    **{
        name: Kind(_one(Fault.STALE), _plain(name))
        for name in ("drop", "delay", "corrupt", "repeat", "reorder")
    },
    "drop-setpoints": Kind(_one(Fault.AMPLIFIER), _plain("drop-setpoints"), own_timeout=True),
    "host's end lost": Kind(_one(Fault.LINK), own_timeout=True),
    "stuck": Kind(_one(Fault.SENSOR), _channel("stuck")),
    "frozen": Kind(_one(Fault.SENSOR), _channel("frozen"), shows=_FROZEN_SHOWS),
    "saturated": Kind(_one(Fault.SENSOR), _channel("saturated")),
    "trip": Kind(_one(Fault.AMPLIFIER), _channel("trip")),
    "encoder": Kind(_one(Fault.DRIVE), _axis("encoder")),
    "skew": Kind(_one(Fault.DRIVE), _size("skew", 0.03, 0.1)),
    "nan-coil": Kind(_one(Fault.READING), _channel("nan-coil")),
    # Beyond limits: a beam, its speed, the platform's height and tilt, a coil in the long run.
    "shift": Kind(_one(Fault.BEAM), _size("shift", 0.15, 0.3)),
    "race": Kind(_one(Fault.VELOCITY), _size("race", 1.5, 3.0)),
    "push": Kind(_one(Fault.GAP), _size("push", 40.0, 80.0), shows=_PUSH_SHOWS, states=HOLDING),
    "tilt": Kind(_one(Fault.POSE), _size("tilt", 0.55, 0.65), shows=_TILT_SHOWS, states=HOLDING),
    "heat": Kind(_one(Fault.HEAT), shows=_HEAT_SHOWS, states=("EXCITING",)),
    # It stands still for longer than it may, and for less than until its setpoints expire: its
    # cycles count from where it runs again.
    "loop held up": Kind(_one(Fault.LATE)),
    "loop killed": Kind(_one(Fault.LOOP), own_timeout=True),
    "loop stopped": Kind(_one(Fault.LOOP), own_timeout=True),
    "supervisor killed": Kind(_one(Fault.SUPERVISOR)),
    "supervisor stopped": Kind(_one(Fault.SUPERVISOR), shows=_SILENCE_SHOWS),
    "stop": Kind(_one(Fault.STOPPED)),
    "disk full": Kind(),
    "recorder killed": Kind(),
    "socket flooded": Kind(),
    "memory pressure": Kind(states=HOLDING),  # to bring it about takes a moment
    "client gone, go on": Kind(states=("EXCITING", "MOVING")),
    "client gone, land": Kind(states=("EXCITING", "MOVING")),
}
# A port that goes is seen at once. A node that leaves a CAN bus is merely silent.
_SERIAL = {
    "bus-off": Kind(_one(Fault.STALE), _plain("bus-off"), own_timeout=True),
    "disconnect": Kind(_one(Fault.LINK), _plain("disconnect"), own_timeout=True),
    "nan-axis": Kind(_one(Fault.READING), _axis("nan-axis")),
}
_CAN = {
    # The host's own controller, whose driver says so.
    "bus-off": Kind(_one(Fault.LINK), _plain("bus-off"), own_timeout=True),
    "disconnect": Kind(_one(Fault.STALE), _plain("disconnect"), own_timeout=True),
}
