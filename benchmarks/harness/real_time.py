"""Give loops and emulated electronics real-time priority, if this user may."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

WITNESS, LOOP, ELECTRONICS = 55, 50, 45


@dataclass(frozen=True)
class Rights:
    """Rights of a process: FIFO priority, 0 for none; locked memory in MB."""

    priority: int
    locked_mb: float

    @classmethod
    def of(cls, pid: int) -> Rights:
        """Return the rights that the main thread of a process has."""
        policy = os.sched_getscheduler(pid) & ~os.SCHED_RESET_ON_FORK
        priority = os.sched_getparam(pid).sched_priority if policy == os.SCHED_FIFO else 0
        status = Path(f"/proc/{pid}/status").read_text()
        (locked,) = (line.split()[1] for line in status.splitlines() if line.startswith("VmLck"))
        return cls(priority, int(locked) / 1024)


def hurry(priority: int, pid: int | None = None) -> bool:
    """Give this thread, or all threads of a process, a FIFO priority; return whether permitted."""
    try:
        for task in _tasks(pid):
            # Its children are not part of the loop.
            policy = os.SCHED_FIFO | os.SCHED_RESET_ON_FORK
            os.sched_setscheduler(task, policy, os.sched_param(priority))
    except (OSError, AttributeError):
        return False
    return True


def relax() -> None:
    """Give this thread the default scheduling again."""
    if hasattr(os, "SCHED_OTHER"):
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))


def _tasks(pid: int | None) -> list[int]:
    return [0] if pid is None else [int(p.name) for p in Path(f"/proc/{pid}/task").iterdir()]
