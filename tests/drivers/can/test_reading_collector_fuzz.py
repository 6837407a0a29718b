"""A CAN reading is the first complete set of right frames of its cycle, whatever else arrives."""

from __future__ import annotations

from collections import deque
from time import perf_counter

import numpy as np
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, rule
from independent_frame_decoder import CHANGES, CYCLES, FramesTogether, changed, equal

from levid.config.buses import CanBus
from levid.drivers.can.bus_link import CanLink
from levid.drivers.can.reading_collector import Readings
from levid.wire.can.can_frames import load_frames
from levid.wire.can.kernel_frame import OTHER, ReceivedFrame

NEVER = 1 << 30
LENGTH = 8
SEEDS = st.integers(0, 1 << 16)
FRAMES = st.integers(0, 2)


class Wire:
    """A bus that brings the frames it is given."""

    def __init__(self) -> None:
        self.coming: deque[ReceivedFrame] = deque()

    def receive(self, _: float) -> ReceivedFrame | None:
        return self.coming.popleft() if self.coming else None


class NoisyBus(RuleBasedStateMachine):
    """Frames of a device with nine sensors, in three classic frames; `collect` ends a cycle."""

    def __init__(self) -> None:
        super().__init__()
        self.group = load_frames(None, 9, 9, False).gap
        link = CanLink("main", CanBus(interface="virtual", channel="noise"))
        self.wire = link._bus = Wire()
        self.link, self.readings = link, Readings("noise", link, self.group, NEVER)
        self.out, self.last = np.zeros(9), np.zeros(9)
        self.sent: list[tuple[int, bytes]] = []
        self.stale, self.clean = 0, None

    @initialize(cycle=st.integers(0, CYCLES - 1))
    def begin(self, cycle: int) -> None:
        self.cycle = cycle
        self.readings.begin(cycle)

    @rule(seed=SEEDS)
    def all_frames_arrive(self, seed: int) -> None:
        self.sent += self._frames(seed)

    @rule(seed=SEEDS, i=FRAMES)
    def frame_arrives(self, seed: int, i: int) -> None:
        self.sent.append(self._frames(seed)[i])

    @rule(seed=SEEDS, i=FRAMES, changes=CHANGES)
    def changed_frame_arrives(self, seed: int, i: int, changes) -> None:
        can_id, data = self._frames(seed)[i]
        self.sent.append((can_id, changed(data, changes)))

    @rule(seed=SEEDS, i=FRAMES, age=st.one_of(st.integers(1, 70), st.just(16)))
    def frame_of_another_cycle_arrives(self, seed: int, i: int, age: int) -> None:
        self.sent.append(self._frames(seed, age)[i])

    @rule(can_id=st.integers(-1, 0x7FF), data=st.binary(max_size=64))
    def foreign_frame_arrives(self, can_id: int, data: bytes) -> None:
        self.sent.append((can_id, data))

    @rule(step=st.integers(1, 3))
    def collect(self, step: int) -> None:
        readings, group = self.readings, self.group
        self.wire.coming.extend(OTHER if i < 0 else ReceivedFrame(i, d, 0.0) for i, d in self.sent)
        readings.collect(perf_counter() + 1e6, self.out)
        together = FramesTogether(group.ids, LENGTH)
        for can_id, data in self.sent:
            if not together.complete:
                together.take(can_id, data, self.cycle)
        right = together.right(self.cycle)
        self.stale += not right
        assert readings.fresh == right
        assert readings.watch.stale == self.stale
        # Rejected frames change no value.
        assert equal(self.out, together.values(group.unit) if right else self.last)
        self.last[:] = self.out
        ours = sum(can_id in group.ids for can_id, _ in self.sent)
        self.sent.clear()
        self.cycle = (self.cycle + step) % CYCLES
        self.link.drain()
        readings.begin(self.cycle)
        clean = readings.watch._in_a_row == 0
        # If more frames than a reading arrived, the cycle may be either.
        assert clean == right or (right and ours > len(group.ids))

    def _frames(self, seed: int, age: int = 0) -> list[tuple[int, bytes]]:
        values = np.random.default_rng(seed).uniform(-(2**15), 2**15, 9)
        values[seed % 64 : seed % 64 + 1] = np.nan
        return self.group.encode(values * self.group.unit, (self.cycle - age) % CYCLES, seed % 16)


TestNoisyBus = NoisyBus.TestCase
TestNoisyBus.settings = settings(max_examples=settings.default.max_examples // 10)
