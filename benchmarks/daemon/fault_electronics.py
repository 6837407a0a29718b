"""Electronics of a rig that play more faults than the shipped ones, and confirm each at once.

On its own: `python fault_electronics.py RIG.yaml`. Lines on standard input are those of `levid
electronics` and these, of readings that no device of ours sends by itself: `nan-coil 3` (a force
that is no number), `nan-axis x1` (serial only: on CAN a position is a whole number), `shift 0.2`
(encoders of both motors off by so many metres), `race 2.0` (they run on at so many m/s), `tilt 0.6`
(somebody tilts the platform with so many N m). Each is answered by a line of JSON: what was done,
or the error, and the state as it was just before.

A fault begins as a cycle does, before its answers leave, so that cycles can be counted from the
first one on that it touches.
"""

from __future__ import annotations

import ctypes
import gc
import json
import math
import signal
import sys
import threading
from dataclasses import dataclass, field
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Any

import numpy as np
from numpy.typing import NDArray

from levid.config.rig import load_rig
from levid.sim.electronics.core import Core
from levid.sim.electronics.faults import AXES, InjectionError
from levid.sim.electronics.rig import Electronics

READY = "electronics answer"
_MCL_CURRENT = 1
_CYCLE_S = 1.0
"""How long a fault waits for a cycle to begin with."""


@dataclass
class _More:
    nan_coils: set[int] = field(default_factory=set)
    nan_axes: set[int] = field(default_factory=set)
    shift_m: float = 0.0
    race_m_s: float = 0.0
    tilt_n_m: float = 0.0


class Faulty:
    """Plays a line on electronics that answer; `command` returns what it answers."""

    def __init__(self, electronics: Electronics) -> None:
        self._electronics, self._more = electronics, _More()
        self._due: tuple[str, SimpleQueue[dict[str, Any]]] | None = None
        self._cut_short = 0
        core = electronics.core
        sample, push, take_over = core._sample, core.plant.push, core.apply_setpoints

        def sampled() -> None:
            due, self._due = self._due, None
            if due is not None:
                due[1].put(self._carry_out(due[0]))
            sample()
            self._spoil(core)

        def pushed(wrench: NDArray[np.float64]) -> None:
            push(wrench + np.array([0.0, self._more.tilt_n_m, 0.0]))

        def taken_over(renews: bool = True) -> None:
            acted = core.acting_n.any()
            take_over(renews)
            self._cut_short += bool(acted and not renews and not core.acting_n.any())

        # Nothing else of the shipped electronics knows of these faults, or of parts of a period.
        core._sample = sampled  # type: ignore[method-assign]
        core.plant.push = pushed  # type: ignore[method-assign]
        core.apply_setpoints = taken_over  # type: ignore[method-assign]

    def command(self, line: str) -> dict[str, Any]:
        """Carry out a line, `status` too; return what was done and the state before it."""
        if line in ("status", "clear"):
            with self._electronics.core.lock:
                return self._carry_out(line)
        answers: SimpleQueue[dict[str, Any]] = SimpleQueue()
        self._due = line, answers
        try:
            return answers.get(timeout=_CYCLE_S)
        except Empty:
            self._due = None
            return {"error": "no cycle begins"}

    def _carry_out(self, line: str) -> dict[str, Any]:
        before = self._electronics.status()
        # On a serial port zero force may come within a period: force acted in that one as well.
        before["forced_periods"] = self._electronics.core.forced_periods + self._cut_short
        try:
            did = line if line == "status" else self._do(line)
        except (InjectionError, ValueError, IndexError) as error:
            return {"error": str(error), **before}
        return {"did": did, **before}

    def _do(self, line: str) -> str:
        more, (name, *arguments) = self._more, line.split()
        argument = arguments[0] if arguments else ""
        match name:
            case "nan-coil":
                more.nan_coils.add(int(argument))
            case "nan-axis":
                more.nan_axes.add(AXES.index(argument))
            case "shift":
                more.shift_m = float(argument)
            case "race":
                more.race_m_s = float(argument)
            case "tilt":
                more.tilt_n_m = float(argument)
            case "clear":
                self._more = _More()
                return self._electronics.injector.command(line)
            case _:
                return self._electronics.injector.command(line)
        return line

    def _spoil(self, core: Core) -> None:
        more = self._more
        more.shift_m += more.race_m_s * core.period_s
        for i in more.nan_coils:
            core.force_n[i] = math.nan
        core.axes[:2, 0] += more.shift_m
        core.axes[:2, 1] += more.race_m_s
        for i in more.nan_axes:
            core.axes[i, 0] = math.nan


def main(rig_file: Path) -> None:
    """Answer on the rig's buses and to lines, until SIGTERM or the end of the input."""
    done = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: done.set())
    electronics = Electronics(load_rig(rig_file), rig_file.parent)
    faulty = Faulty(electronics)

    def obey() -> None:
        for line in sys.stdin:
            print(json.dumps(faulty.command(line.strip())), flush=True)
        done.set()  # whoever began this is gone

    with electronics:
        threading.Thread(target=obey, daemon=True).start()
        gc.collect()
        gc.freeze()  # a walk over all that was imported would be a stale reading
        ctypes.CDLL(None).mlockall(_MCL_CURRENT)  # real ones know no pages; refused, they may wait
        print(READY, file=sys.stderr, flush=True)
        while not done.wait(0.2):
            pass


if __name__ == "__main__":
    main(Path(sys.argv[1]))
