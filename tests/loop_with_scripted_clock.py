"""The daemon's loop on loopback devices, cycle by cycle as a script says; no clock, no process."""

from __future__ import annotations

import os
from collections.abc import Callable
from typing import Any

import numpy as np

from levid.config.rig import RigConfig, load_rig
from levid.config.session import Step
from levid.config.shipped import shipped
from levid.daemon.control.control_cycle import Controller
from levid.daemon.ipc.flight_segment_stream import Logged, SegmentFeeder
from levid.daemon.ipc.shared_memory import SharedMemory
from levid.daemon.ipc.shared_status_words import Word
from levid.daemon.loop.clock import Clock
from levid.daemon.loop.prepare_first_cycle import warm_up
from levid.daemon.loop.real_time_loop import TimedLoop
from levid.daemon.planning.plan import plan_steps
from levid.drivers.base import Context, Devices
from levid.drivers.open_backends import open_devices

RIG = shipped("rigs/loopback.yaml")
LIFT = {"unload_s": 0.2, "ramp_s": 0.2, "settle_s": 0.5}


class ScriptEnd(BaseException):
    """The script is over: nothing of the loop may catch it."""


class ScriptedClock(Clock):
    """Every wait ends at once, after the script was told its number."""

    def __init__(self, script: Callable[[int], None]) -> None:
        self.n, self.script, self.skipped = 0, script, 0
        self.epoch_ns, self.late_s, self.overslept_ns = 0, 0.0, -1

    def start(self) -> None:
        return

    def wait(self) -> float:
        self.n += 1
        self.script(self.n)
        return self.late_s


class ScriptedLoop:
    """A loop at 1 kHz and a supervisor that gives signs of life every ten cycles unless `silent`.

    `forces` is the sum of the forces last written to the coils, in N. `recover` recovers the
    devices after a fault. Only with `timed` may a cycle be too slow, by time.perf_counter_ns.
    """

    def __init__(
        self,
        wrap: Callable[[Devices], Devices] = lambda devices: devices,
        before_fault_s: float = 10.0,
        limits: dict[str, Any] | None = None,
        recover: Callable[[], None] = lambda: None,
        timed: bool = False,
        **service: Any,
    ) -> None:
        plain = load_rig(RIG).model_dump()
        plain["service"] |= service
        plain["limits"] |= limits or {}
        plain["recording"]["before_fault_s"] = before_fault_s
        plain["rate_hz"] = 1000.0
        self.rig = rig = RigConfig.model_validate(plain)
        self.shared = SharedMemory(rig)
        self.control_words = self.shared.control_words
        self.controller = Controller(rig, 1e-3, self.shared.control)
        self.devices = devices = wrap(open_devices(Context(rig, 1e-3, RIG.parent)))
        warm_up(self.controller, devices, np.zeros(1, self.shared.dtype), rig, -1)
        self.parent, self.silent, self.forces = os.getppid(), False, 0.0
        self.plans = 0
        self._feeder: SegmentFeeder | None = None
        self._script: Callable[[int], None] = lambda _: None
        write = devices.amplifiers.write

        def seen(coil_n: np.ndarray) -> None:
            self.forces = float(np.abs(coil_n).sum())
            write(coil_n)

        devices.amplifiers.write = seen  # type: ignore[method-assign]
        self.clock, self._recover = ScriptedClock(self._cycle), recover
        self.restart()
        if not timed:  # there is no clock: how long a cycle takes says nothing
            self.loop._longest_ns = 1 << 62

    def restart(self) -> None:
        """Replace the loop, as the supervisor does after it has died."""
        self.loop = TimedLoop(
            self.rig, self.controller, self.devices, self.clock, self.shared,
            self._recover, self.parent,
        )  # fmt: skip

    def feed(self) -> None:
        """Pass on as many segments of the plan as the loop has room for."""
        assert self._feeder is not None
        self._feeder.feed()

    def fly(self, *steps: dict[str, Any]) -> None:
        """Announce a plan of these steps, from the manipulator's zero."""
        plan = plan_steps([Step(**step) for step in steps], "scripted", self.rig, 0.0, 0.0)
        self.plans += 1
        self.control_words[Word.LAND_RAMP], self.control_words[Word.LAND_RELEASE] = 500, 200
        segments = [Logged(s, 0) for step in plan.steps for s in step.segments()]
        self._feeder = SegmentFeeder(
            self.shared.segment_stream, self.control_words, self.plans, segments
        )

    def run(self, script: Callable[[int], None], cycles: int) -> None:
        """Run so many cycles, each after script(its number)."""
        self._script, self._last = script, cycles
        try:
            self.loop.run()
        except ScriptEnd:
            return

    def _cycle(self, n: int) -> None:
        if n > self._last:
            raise ScriptEnd
        if not n % 10 and not self.silent:
            self.control_words[Word.BEAT] += 1
            if self._feeder is not None:
                self.feed()
        self._script(n)
