"""Noise into what takes frames of a CAN cycle together: a host's readings, a device's setpoints."""

from __future__ import annotations

import struct
from collections import deque
from time import perf_counter

import numpy as np

from levid.benchmarks.bus.fuzz_can import crc8
from levid.benchmarks.bus.mutations import Outcome, are, mutated
from levid.config.buses import CanBus
from levid.config.rig import load_rig
from levid.config.shipped import shipped
from levid.drivers.can.bus_link import CanLink
from levid.drivers.can.readings import Readings
from levid.sim.electronics.can_emulator import CanElectronics
from levid.sim.electronics.emulated_rig import Electronics
from levid.wire.can.can_frames import ValueFrames, load_frames
from levid.wire.can.kernel_frame import OTHER, ReceivedFrame
from levid.wire.device_protocol import CYCLES

_PATIENT = 1 << 30
_LENGTH, _MOST = 8, 2**15
Sent = tuple[int, bytes]


class _Wire:
    """A bus that brings the frames it is given."""

    def __init__(self) -> None:
        self.coming: deque[ReceivedFrame] = deque()

    def receive(self, _: float) -> ReceivedFrame | None:
        return self.coming.popleft() if self.coming else None

    def send(self, can_id: int, data: bytes) -> None: ...

    def shutdown(self) -> None: ...


class _Together:
    """Frames of one cycle by other means than levid's: the first of each ID, all or nothing."""

    def __init__(self, ids: tuple[int, ...]) -> None:
        self._ids, self.parts = ids, dict[int, bytes]()

    @property
    def whole(self) -> bool:
        return len(self.parts) == len(self._ids)

    def take(self, can_id: int, data: bytes, cycle: int) -> None:
        fits = can_id in self._ids and len(data) == _LENGTH and not (data[-2] ^ cycle) & 0xF
        if fits and can_id not in self.parts:
            self.parts[can_id] = data

    def right(self, cycle: int) -> bool:
        covered = {i: struct.pack(">HH", i, cycle >> 4) + d for i, d in self.parts.items()}
        return self.whole and all(crc8(c[:-1]) == c[-1] for c in covered.values())

    def are(self, found: np.ndarray, unit: float) -> bool:
        counts = [c for i in self._ids for c in struct.unpack("<3h", self.parts[i][:6])]
        told = [c * unit if c != -_MOST else np.nan for c in counts]
        return are(found, told, _MOST * unit)


def readings_taken(n: int, rng: np.random.Generator) -> Outcome:
    """Cycles whose three frames come among noise, others' frames and frames of other cycles.

    `n` frames in all. A reading must be taken where the first three that fit are right; values of
    one that is not stay those of the last; what is left over is no part of the next cycle. A cycle
    without a reading is stale, and one in which nothing but a reading came is clean.
    """
    group = load_frames(None, 9, 9, False).gap
    link, wire = CanLink("noise", CanBus(interface="virtual", channel="noise")), _Wire()
    link._bus = wire
    readings = Readings("noise", link, group, _PATIENT)
    watch, out, last = readings.watch, np.zeros(9), np.zeros(9)
    tried = accepted = wrong = stale = cycle = 0
    clean: bool | None = None
    while tried < n:
        cycle = (cycle + int(rng.integers(1, 4))) % CYCLES
        link.drain()
        readings.begin(cycle)
        # Of a cycle with a reading and more besides, the watch alone says what it was.
        wrong += clean is not None and clean != (watch._in_a_row == 0)
        sent = _among_noise(group, cycle, int(rng.integers(16)), rng)
        tried += len(sent)
        wire.coming.extend(OTHER if i < 0 else ReceivedFrame(i, d, 0.0) for i, d in sent)
        readings.collect(perf_counter() + 1e6, out)
        heard = _Together(group.ids)
        for can_id, data in sent:
            if heard.whole:
                break
            heard.take(can_id, data, cycle)
        right = heard.right(cycle)
        accepted += readings.fresh
        stale += not right
        wrong += readings.fresh != right or watch.stale != stale
        wrong += not (heard.are(out, group.unit) if right else np.array_equal(out, last, True))
        last[:] = out
        ours = [can_id for can_id, _ in sent if can_id in group.ids]
        clean = True if right and len(ours) == len(group.ids) else None if right else False
    return Outcome(tried, accepted, wrong, accepted / tried)


def setpoints_taken(n: int, rng: np.random.Generator) -> Outcome:
    """Sets of setpoints in three frames, of which some are lost, changed, of another cycle or set.

    Forces must be those of one set of the cycle at hand, all of whose frames came and are right,
    or stay as they were.
    """
    path = shipped("rigs/can.yaml")
    electronics = Electronics(load_rig(path), path.parent)
    bus = next(b for b in electronics.emulators if isinstance(b, CanElectronics) and b._amplifiers)
    group = bus._frames.setpoint
    told: list[np.ndarray] = []
    bus._core.setpoints = lambda coil_n: told.append(coil_n.copy())  # type: ignore[method-assign]
    tried = accepted = wrong = cycle = number = 0
    heard, heard_set = _Together(group.ids), 0
    while tried < n:
        if rng.random() < 0.5:  # else another set of the same cycle
            cycle = (cycle + int(rng.integers(1, 4))) % CYCLES
            bus._cycle = cycle
            group.begin()  # as with Sync
            heard = _Together(group.ids)
        number = (number + int(rng.integers(3))) % 16
        for can_id, data in _among_noise(group, cycle, number, rng):
            if can_id not in group.ids:
                continue  # the electronics hand on each ID by itself
            tried += 1
            told.clear()
            bus._setpoint(can_id, data)
            tag = data[-2] >> 4 if len(data) > 1 else 0
            if heard.whole or tag != heard_set:
                heard, heard_set = _Together(group.ids), tag
            was = len(heard.parts)
            heard.take(can_id, data, cycle)
            right = len(heard.parts) > was and heard.right(cycle)
            accepted += len(told)
            wrong += len(told) != right
            if right and told:
                wrong += not heard.are(told[0], group.unit)
    return Outcome(tried, accepted, wrong, accepted / tried)


def _among_noise(group: ValueFrames, cycle: int, tag: int, rng: np.random.Generator) -> list[Sent]:
    """Return the frames of a cycle, mostly all and in order, some lost, changed or twice."""
    values = rng.uniform(-_MOST, _MOST, group.channels) * group.unit
    values[rng.random(group.channels) < 0.02] = np.nan
    sent = group.encode(values, cycle, tag)
    if rng.random() < 0.4:
        return sent
    for _ in range(int(rng.integers(1, 4))):
        at, kind = int(rng.integers(len(sent) + 1)), int(rng.integers(6))
        one = sent[at % len(sent)] if sent else (group.ids[0], b"")
        if kind == 0 and sent:
            del sent[at % len(sent)]
        elif kind == 1:
            sent.insert(at, one)
        elif kind == 2:
            sent.insert(at, (int(rng.integers(-1, 0x800)), rng.bytes(int(rng.integers(65)))))
        elif kind == 3:
            other = (cycle - int(rng.integers(1, 70))) % CYCLES
            sent.insert(at, group.encode(values, other, tag)[int(rng.integers(len(group.ids)))])
        elif kind == 4 and sent:
            sent[at % len(sent)] = one[0], mutated(one[1], rng)
        else:  # other values with everything right, or of another set
            again = group.encode(-values, cycle, (tag + int(rng.integers(2))) % 16)
            sent.insert(at, again[int(rng.integers(len(again)))])
    return sent
