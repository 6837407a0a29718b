"""Emulate a rig's electronics with additional faults, and confirm each fault at once.

Run as `python fault_injecting_electronics.py RIG.yaml`. Its standard input takes the lines of
`levid electronics` and these: `nan-coil 3` (coil force NaN), `nan-axis x1` (position NaN, serial
only), `shift 0.2` (offset of both motor encoders in m), `race 2.0` (drift of both encoders in m/s),
`tilt 0.6` (torque on the platform in N m). The answer to each is a line of JSON: the state just
before it, and `error` if the line failed.

A fault begins at the start of a cycle, before its answers are sent, so that affected cycles can be
counted.
"""

from __future__ import annotations

import ctypes
import gc
import json
import math
import signal
import sys
import threading
import time
from collections import deque
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Any

import numpy as np
from numpy.typing import NDArray

from levid.config.rig import load_rig
from levid.sim.electronics.emulated_devices import Core
from levid.sim.electronics.emulated_rig import Electronics
from levid.sim.electronics.faults import AXES, InjectionError

_MORE = ("nan-coil", "nan-axis", "shift", "race", "tilt")
ENDS = 256
"""Last periods with force of which the status has the ends, monotonic times in s."""
_CYCLE_S = 1.0
"""Timeout of a fault that waits for the start of a cycle."""


class FaultInjector:
    """Add faults to running electronics; `command` carries out a line."""

    def __init__(self, electronics: Electronics) -> None:
        self._electronics = electronics
        self._more: dict[str, float] = {}
        self._raced_m = 0.0
        self._due: tuple[str, SimpleQueue[dict[str, Any]]] | None = None
        self._cut_short = 0
        core = electronics.core
        sample, push, take_over = core._sample, core.plant.push, core.apply_setpoints
        pass_period = core.pass_period
        self._ends_s = deque[float](maxlen=ENDS)

        def sampled() -> None:
            due, self._due = self._due, None
            if due is not None:
                due[1].put(self._carry_out(due[0]))
            sample()
            self._spoil(core)

        def pushed(wrench: NDArray[np.float64]) -> None:
            push(wrench + np.array([0.0, self._more.get("tilt", 0.0), 0.0]))

        def taken_over(renews: bool = True) -> None:
            acted = core.acting_n.any()
            take_over(renews)
            if acted and not renews and not core.acting_n.any():
                self._cut_short += 1
                self._ends_s.append(time.monotonic())

        def passed() -> None:
            before = core.forced_periods
            pass_period()
            if core.forced_periods > before:
                self._ends_s.append(time.monotonic())

        # The shipped electronics have no hooks for these faults or for parts of a period.
        core._sample = sampled  # type: ignore[method-assign]
        core.plant.push = pushed  # type: ignore[method-assign]
        core.apply_setpoints = taken_over  # type: ignore[method-assign]
        core.pass_period = passed  # type: ignore[method-assign]

    def command(self, line: str) -> dict[str, Any]:
        """Carry out a line; return the state before it."""
        if line in ("status", "clear"):
            with self._electronics.core.lock:
                return self._carry_out(line)
        answers: SimpleQueue[dict[str, Any]] = SimpleQueue()
        self._due = line, answers
        try:
            return answers.get(timeout=_CYCLE_S)
        except Empty:
            self._due = None
            return {"error": "no cycle began"}

    def _carry_out(self, line: str) -> dict[str, Any]:
        before = self._electronics.status()
        # A serial device may end the force within a period; this period counts as well.
        before["forced_periods"] = self._electronics.core.forced_periods + self._cut_short
        before["force_ends_s"] = list(self._ends_s)
        name, _, argument = line.partition(" ")
        try:
            if name in _MORE:
                self._more[name] = AXES.index(argument) if name == "nan-axis" else float(argument)
            elif name != "status":
                self._electronics.injector.command(line)
        except (InjectionError, ValueError) as error:
            before["error"] = str(error)
        if name == "clear":
            self._more.clear()
            self._raced_m = 0.0
        return before

    def _spoil(self, core: Core) -> None:
        race_m_s = self._more.get("race", 0.0)
        self._raced_m += race_m_s * core.period_s
        core.axes[:2, 0] += self._more.get("shift", 0.0) + self._raced_m
        core.axes[:2, 1] += race_m_s
        if "nan-coil" in self._more:
            core.force_n[int(self._more["nan-coil"])] = math.nan
        if "nan-axis" in self._more:
            core.axes[int(self._more["nan-axis"]), 0] = math.nan


def main(rig_file: Path) -> None:
    """Answer on the rig's buses and on standard input, until SIGTERM or the end of the input."""
    done = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: done.set())
    electronics = Electronics(load_rig(rig_file), rig_file.parent)
    injector = FaultInjector(electronics)

    def obey() -> None:
        for line in sys.stdin:
            print(json.dumps(injector.command(line.strip())), flush=True)
        done.set()  # the parent process has ended

    with electronics:
        gc.collect()
        gc.freeze()  # a garbage collection would make a reading stale
        ctypes.CDLL(None).mlockall(1)  # real electronics have no page faults
        threading.Thread(target=obey, daemon=True).start()
        done.wait()


if __name__ == "__main__":
    main(Path(sys.argv[1]))
