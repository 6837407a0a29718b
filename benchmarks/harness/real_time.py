"""Real-time priority where it may be had, as on the rig, for loops and emulated electronics."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

WITNESS, LOOP, ELECTRONICS = 55, 50, 45


@dataclass(frozen=True)
class Rights:
    """What the kernel grants a process: priority first in, first out, 0 for none; MB locked."""

    priority: int
    locked_mb: float

    @classmethod
    def of(cls, pid: int) -> Rights:
        """Return those of the main thread of a process, as they are and not as asked for."""
        policy = os.sched_getscheduler(pid) & ~os.SCHED_RESET_ON_FORK
        priority = os.sched_getparam(pid).sched_priority if policy == os.SCHED_FIFO else 0
        status = Path(f"/proc/{pid}/status").read_text()
        (locked,) = (line.split()[1] for line in status.splitlines() if line.startswith("VmLck"))
        return cls(priority, int(locked) / 1024)


def hurry(priority: int, pid: int | None = None) -> bool:
    """Run this thread, or all threads of a process, first in, first out; return whether it may."""
    try:
        for task in _tasks(pid):
            # What this thread starts is no part of the loop.
            policy = os.SCHED_FIFO | os.SCHED_RESET_ON_FORK
            os.sched_setscheduler(task, policy, os.sched_param(priority))
    except (OSError, AttributeError):
        return False
    return True


def relax() -> None:
    """Run this thread as any other again."""
    if hasattr(os, "SCHED_OTHER"):
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))


def _tasks(pid: int | None) -> list[int]:
    return [0] if pid is None else [int(p.name) for p in Path(f"/proc/{pid}/task").iterdir()]
