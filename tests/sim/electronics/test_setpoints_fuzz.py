"""Emulated amplifiers apply only the complete, right setpoints of one set and one cycle."""

from __future__ import annotations

import numpy as np
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, rule
from independent_frame_decoder import CHANGES, CYCLES, FramesTogether, changed, equal

from levid.config.rig import load_rig
from levid.config.shipped import shipped
from levid.sim.electronics.can_emulator import CanElectronics
from levid.sim.electronics.emulated_rig import Electronics

RIG = shipped("rigs/can.yaml")
ELECTRONICS = Electronics(load_rig(RIG), RIG.parent)
LENGTH = 8
SEEDS = st.integers(0, 1 << 16)
FRAMES = st.integers(0, 2)


class NoisySetpoints(RuleBasedStateMachine):
    """A host sends sets of three frames; some are lost, changed, or of another cycle or set."""

    def __init__(self) -> None:
        super().__init__()
        buses = [bus for bus in ELECTRONICS.emulators if isinstance(bus, CanElectronics)]
        (self.bus,) = (bus for bus in buses if bus._amplifiers)
        self.group = self.bus._frames.setpoint
        self.applied: list[np.ndarray] = []
        self.bus._core.setpoints = lambda coil_n: self.applied.append(coil_n.copy())
        self.bus._set = self.set = 0

    @initialize(cycle=st.integers(0, CYCLES - 1))
    def begin(self, cycle: int) -> None:
        self.cycle = self.bus._cycle = cycle
        self.group.begin()  # as at a Sync
        self.together, self.heard_set = FramesTogether(self.group.ids, LENGTH), 0

    @rule(step=st.integers(1, 3))
    def next_cycle_begins(self, step: int) -> None:
        self.begin((self.cycle + step) % CYCLES)

    @rule(step=st.integers(1, 15))
    def next_set_begins(self, step: int) -> None:
        self.set = (self.set + step) % 16

    @rule(seed=SEEDS)
    def all_frames_arrive(self, seed: int) -> None:
        for can_id, data in self._frames(seed):
            self._arrive(can_id, data)

    @rule(seed=SEEDS, i=FRAMES)
    def frame_arrives(self, seed: int, i: int) -> None:
        self._arrive(*self._frames(seed)[i])

    @rule(seed=SEEDS, i=FRAMES, changes=CHANGES)
    def changed_frame_arrives(self, seed: int, i: int, changes) -> None:
        can_id, data = self._frames(seed)[i]
        self._arrive(can_id, changed(data, changes))

    @rule(seed=SEEDS, i=FRAMES, age=st.one_of(st.integers(1, 70), st.just(16)))
    def frame_of_another_cycle_arrives(self, seed: int, i: int, age: int) -> None:
        self._arrive(*self._frames(seed, age)[i])

    def _frames(self, seed: int, age: int = 0) -> list[tuple[int, bytes]]:
        values = np.random.default_rng(seed).uniform(-(2**15), 2**15, 9) * self.group.unit
        return self.group.encode(values, (self.cycle - age) % CYCLES, self.set)

    def _arrive(self, can_id: int, data: bytes) -> None:
        self.bus._setpoint(can_id, data)
        number = data[-2] >> 4 if len(data) > 1 else 0
        if self.together.complete or number != self.heard_set:
            self.together, self.heard_set = FramesTogether(self.group.ids, LENGTH), number
        taken = self.together.take(can_id, data, self.cycle)
        right = taken and self.together.right(self.cycle)
        assert len(self.applied) == right
        if right:
            assert equal(self.applied.pop(), self.together.values(self.group.unit))


TestNoisySetpoints = NoisySetpoints.TestCase
TestNoisySetpoints.settings = settings(max_examples=settings.default.max_examples // 10)
