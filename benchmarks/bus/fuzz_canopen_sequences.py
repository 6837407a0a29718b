"""Cycles of CANopen drives one after the other, nothing forgotten between them.

What a drive said stays said: an error until it says that there is none, a state that it left for
good; positions count where all three came whole. The fault DRIVE must come in the cycle in which
that first tells it, and once; from then on, no drive is told anything but to stop.
"""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from levid.benchmarks.bus.fuzz_canopen import (
    BEAM_M,
    EMERGENCY,
    ENABLED,
    ENABLED_MASK,
    NODES,
    ROTOR_RAD,
    RPDO,
    CanFrame,
    Wire,
    bend_of,
    came,
    most_bends,
    positions,
    rig_of_drives,
    said,
    speed_of,
)
from levid.benchmarks.bus.mutations import Outcome
from levid.drivers.base import DriveError
from levid.drivers.can.bus_link import CanLink
from levid.drivers.can.canopen_drives import CanDrives
from levid.wire.can.kernel_frame import ReceivedFrame

_QUIET, _NEAR, _CALM = 0.95, 0.99, 0.85
"""Shares of cycles in which nothing is said, drives are in operation, all positions come once."""
_SKEW_COUNTS, _STEPS = 40_000, 30
_STOP, _GO_ON = 0x02, 0x0F
_LONG_S = 1e6
_ROUNDED = 1e-9


@dataclass
class _Told:
    """What a host must know after all that came since it recovered; counts and times in SI."""

    period_s: float
    bends: tuple[float, float, float]
    error: dict[int, bool] = field(default_factory=dict)
    operational: set[int] = field(default_factory=set)
    left: bool = False
    at: list[float] = field(default_factory=lambda: [0.0] * 3)
    before: list[tuple[float, float, float]] = field(default_factory=lambda: [(0.0,) * 3] * 3)
    speed: list[float] = field(default_factory=lambda: [0.0] * 3)
    status_ok: bool = True
    cycle: int = -1
    faulty: bool = False
    doubtful: bool = False

    def hear(self, frames: list[CanFrame]) -> None:
        for can_id, data in frames:
            node = can_id & 0x7F
            if can_id & ~0x7F == EMERGENCY:
                if len(data) == 8:
                    self.error[node] = data[:2] != b"\0\0"
            elif (state := data[0] & 0x7F if data else -1) == 5:
                self.operational.add(node)
            else:
                self.left |= state == 0 or node in self.operational

    def see(self, whole: dict[int, tuple[int, int]], cycle: int) -> None:
        regular, self.cycle = cycle - self.cycle == 1, cycle
        self.status_ok = all(whole[i][0] & ENABLED_MASK == ENABLED for i in NODES)
        for i, (node, unit) in enumerate(zip(NODES, (BEAM_M, BEAM_M, ROTOR_RAD), strict=True)):
            p, last = whole[node][1] * unit, self.before[i]
            if regular:
                # By the limit itself: rounding puts it on either side.
                off = bend_of(p, last) - self.bends[i]
                self.doubtful |= abs(off) < _ROUNDED * self.bends[i]
                self.speed[i] = speed_of(p, last, self.period_s, self.bends[i])
                self.before[i] = p, last[0], last[1]
            else:  # how far it went meanwhile nobody knows: it goes on at the speed it had
                step = self.speed[i] * self.period_s
                self.before[i] = p, p - step, p - 2.0 * step
            self.at[i] = p

    def judge(self, skew_m: float) -> bool:
        """Return whether the fault must come now: it is there, and was not before."""
        askew = abs(self.at[0] - self.at[1]) > skew_m
        now = any(self.error.values()) or not self.status_ok or self.left or askew
        first, self.faulty = now and not self.faulty, self.faulty or now
        return first

    def motion(self, cycle: int) -> list[float]:
        """Return place and speed of beam and rotor; what did not come went on at its speed."""
        since_s = (cycle - self.cycle) * self.period_s
        x1, x2, phi = (p + since_s * v for p, v in zip(self.at, self.speed, strict=True))
        return [0.5 * (x1 + x2), 0.5 * (self.speed[0] + self.speed[1]), phi, self.speed[2]]


def drives_followed(n: int, rng: np.random.Generator) -> Outcome:
    """Sequences of up to _STEPS cycles after a recovery; `n` frames in all."""
    rig, options = rig_of_drives()
    options = options.model_copy(update={"heartbeat_s": _LONG_S})  # this process may be stopped
    link, wire = CanLink("main", rig.can[options.bus]), Wire()
    link._bus = wire  # type: ignore[assignment]
    drives = CanDrives(link, rig, options, Path(), 1 << 30, lambda: math.inf)
    beam, rotor = np.zeros(3), np.zeros(3)
    period_s = 1.0 / rig.rate_hz
    bends = most_bends(rig)
    tried = accepted = wrong = cycle = 0
    while tried < n:
        told, slow = _Told(period_s, bends), rng.random() < 0.5
        _recover(drives)
        for _ in range(_STEPS):
            cycle += int(rng.integers(1, 4)) if rng.random() < 0.1 else 1
            speech = said(rng, _QUIET)
            places = positions(rng, _NEAR, _CALM, _SKEW_COUNTS, slow=slow)
            tried += len(speech) + len(places)
            wire.coming = [ReceivedFrame(can_id, data, 0.0) for can_id, data in speech + places]
            raised = False
            drives.sync(cycle)
            try:
                drives.read(beam, rotor)
            except DriveError:
                raised = True
            told.hear(speech)
            whole = came(places)
            if len(whole) == len(NODES):
                told.see(whole, cycle)
                accepted += 1
            if told.doubtful:
                break
            wrong += bool(drives.stale) != (len(whole) < len(NODES))
            wrong += raised != told.judge(options.skew_m)
            found = [*beam[:2], *rotor[:2]]
            wrong += not np.allclose(found, told.motion(cycle), rtol=1e-9, atol=1e-6)
            wrong += not _goes(drives, wire, told.faulty, rng)
            if told.faulty and rng.random() < 0.3:
                break
    return Outcome(tried, accepted, wrong, accepted / tried)


def _goes(drives: CanDrives, wire: Wire, faulty: bool, rng: np.random.Generator) -> bool:
    """Return whether all drives are told to go to a new place, or to stop if one is at fault."""
    beam, rotor = np.zeros(3), np.zeros(3)
    beam[0], rotor[0] = rng.uniform(-0.1, 0.1), rng.uniform(-3.0, 3.0)
    wire.sent.clear()
    drives.write(beam, rotor)
    x, phi = round(beam[0] / BEAM_M), round(rotor[0] / ROTOR_RAD)
    word = _STOP if faulty else _GO_ON
    return wire.sent == [
        (RPDO + node, struct.pack("<Hi", word, counts))
        for node, counts in zip(NODES, (x, x, phi), strict=True)
    ]


def _recover(drives: CanDrives) -> None:
    """As after `recover`, without its exchange with drives that there are none of."""
    drives.watch.reset()
    drives._checked, drives._stopped, drives._written = True, False, None
    for axis in drives._axes:
        axis.begin(0)
