"""List the faults of the trials: what each does, its deadline, and its expected names.

The number of a trial determines all of it: the kind, drawn from a shuffled list of all kinds, its
channel or size, the state of the flight, and the delay in this state.
"""

from __future__ import annotations

import random
from collections.abc import Callable
from dataclasses import dataclass

from levid.benchmarks.daemon.fault_rig import EXPIRE_CYCLES, RATE_HZ, SUPERVISOR_S
from levid.daemon.control.faults import Fault

BUSES = ("canfd", "serial")
SOON = 3
"""Cycles with force at most, from the first cycle that the fault affects."""
HOLDING = ("LEVITATING", "EXCITING", "MOVING")
FLYING = (*HOLDING, "LANDING")

Draw = random.Random
Line = Callable[[Draw], str]


@dataclass(frozen=True)
class Kind:
    """A kind of fault.

    named: expected names, empty for a harmless fault. line: the command to the electronics, if they
    inject it. own_timeout: the loop is dead or the device does not receive its commands, so only
    the device can end the force. shows: cycles until the fault is visible; deadlines count from
    there. states: states of the flight in which it is injected.
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
        """Cycles with force at most."""
        return self.shows + (EXPIRE_CYCLES + 1 if self.own_timeout else SOON)


@dataclass(frozen=True)
class Case:
    """One trial: kind, command to the electronics, state of the flight and delay in it."""

    bus: str
    number: int
    kind: str
    line: str
    state: str
    delay_s: float


def case_of(bus: str, number: int) -> Case:
    """Return the trial of this number, the same in every run."""
    pack = sorted(kinds(bus))
    Draw(f"{bus} pack {number // len(pack)}").shuffle(pack)
    name = pack[number % len(pack)]
    kind, draw = kinds(bus)[name], Draw(f"{bus} {number}")
    state, delay_s = draw.choice(kind.states), draw.uniform(0.0, 1.0)
    return Case(bus, number, name, kind.line(draw) if kind.line else "", state, delay_s)


def kinds(bus: str) -> dict[str, Kind]:
    """Return every kind of fault on this bus by its name."""
    return _EVERYWHERE | (_SERIAL if bus == "serial" else _CAN)


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
"""Equal readings after which the driver reports a frozen channel."""
_PUSH_SHOWS = 1
"""40 N move 7 kg on the rods beyond 0.85 mm in 17 ms; a cycle is 20 ms."""
_TILT_SHOWS = 3
"""0.55 N m on 195 N m/rad overshoots to 5.6 mrad (limit 4) after half a period of 58 rad/s."""
_HEAT_SHOWS = 67
"""A cold coil (time constant 1 s) with 7.8 N at rest and 7 N rms reaches the limit of 8.8 N after
1.22 s; the excitation fades in for 0.1 s."""

_SILENCE_SHOWS = round(SUPERVISOR_S * RATE_HZ)
"""A stopped process cannot be distinguished from a slow one until then."""

_EVERYWHERE = {
    **{
        name: Kind(_one(Fault.STALE), _plain(name))
        for name in ("drop", "delay", "corrupt", "repeat", "reorder")
    },
    "drop-setpoints": Kind(_one(Fault.AMPLIFIER), _plain("drop-setpoints"), own_timeout=True),
    "stuck": Kind(_one(Fault.SENSOR), _channel("stuck")),
    "frozen": Kind(_one(Fault.SENSOR), _channel("frozen"), shows=_FROZEN_SHOWS),
    "saturated": Kind(_one(Fault.SENSOR), _channel("saturated")),
    "trip": Kind(_one(Fault.AMPLIFIER), _channel("trip")),
    "encoder": Kind(_one(Fault.DRIVE), _axis("encoder")),
    "skew": Kind(_one(Fault.DRIVE), _size("skew", 0.03, 0.1)),
    "nan-coil": Kind(_one(Fault.READING), _channel("nan-coil")),
    # Limits: beam position, beam speed, platform height, tilt, thermal load of a coil.
    "shift": Kind(_one(Fault.BEAM), _size("shift", 0.15, 0.3)),
    "race": Kind(_one(Fault.VELOCITY), _size("race", 1.5, 3.0)),
    "push": Kind(_one(Fault.GAP), _size("push", 40.0, 80.0), shows=_PUSH_SHOWS, states=HOLDING),
    "tilt": Kind(_one(Fault.POSE), _size("tilt", 0.55, 0.65), shows=_TILT_SHOWS, states=HOLDING),
    "heat": Kind(_one(Fault.HEAT), shows=_HEAT_SHOWS, states=("EXCITING",)),
    # Stopped for longer than stall_s but less than the expiry of setpoints: cycles count from its
    # continuation.
    "loop held up": Kind(_one(Fault.LATE)),
    "loop killed": Kind(_one(Fault.LOOP), own_timeout=True),
    "loop stopped": Kind(_one(Fault.LOOP), own_timeout=True),
    "supervisor killed": Kind(_one(Fault.SUPERVISOR)),
    "supervisor stopped": Kind(_one(Fault.SUPERVISOR), shows=_SILENCE_SHOWS),
    "stop": Kind(_one(Fault.STOPPED)),
    "disk full": Kind(),
    "recorder killed": Kind(),
    "socket flooded": Kind(),
    "client gone, go on": Kind(states=("EXCITING", "MOVING")),
    "client gone, land": Kind(states=("EXCITING", "MOVING")),
}
# The host detects a lost port at once. A node that leaves a CAN bus is only silent.
_SERIAL = {
    "bus-off": Kind(_one(Fault.STALE), _plain("bus-off"), own_timeout=True),
    "disconnect": Kind(_one(Fault.LINK), _plain("disconnect"), own_timeout=True),
    "host's end lost": Kind(_one(Fault.LINK), own_timeout=True),
    "nan-axis": Kind(_one(Fault.READING), _axis("nan-axis")),
}
_CAN = {
    # The driver of the host's controller reports this.
    "bus-off": Kind(_one(Fault.LINK), _plain("bus-off"), own_timeout=True),
    "disconnect": Kind(_one(Fault.STALE), _plain("disconnect"), own_timeout=True),
}
