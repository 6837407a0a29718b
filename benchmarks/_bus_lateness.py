"""How punctual 1 kHz is on each backend: whole loops against an empty one, in turns.

Late is a cycle that begins a period late or more. Loops and electronics run at real-time priority
where that may be had, the empty one too; what carries udp's frames has none, nor can it be given.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from pathlib import Path

import _real_time
import numpy as np
from _bus_rigs import RATE_HZ, TIMED, cycle_of, electronics_of, opened, rig_on, rig_text
from _shares import Round, again, ratio_figures
from _table import Figure

from levid.config.service import Realtime
from levid.daemon.clock import RealClock
from levid.daemon.realtime import be_punctual

_MOST_TIMES = 3
_LABELS = {
    "canfd": "CAN FD on local sockets",
    "canfd_udp": "CAN FD by udp_multicast",
    "serial": "serial on a pty",
}


def lateness_figures(seconds: float, rounds: int) -> list[Figure]:
    """Return the share of late cycles of each backend and of the empty loop in turns with it.

    Also the 95 % interval of their ratio, and the share of stale readings. Where too few are late
    to tell, it goes on for up to _MOST_TIMES as many rounds.
    """
    figures: list[Figure] = []
    for name in TIMED:
        with tempfile.TemporaryDirectory() as folder:
            figures += _lateness(name, Path(folder), seconds, rounds)
    return figures


def _lateness(name: str, folder: Path, seconds: float, rounds: int) -> list[Figure]:
    path = folder / "rig.yaml"
    path.write_text(rig_text(name, folder))
    electronics = electronics_of(path)
    turns: list[Round] = []
    try:
        devices = opened(rig_on(name, folder), folder)
        try:
            _real_time.hurry(_real_time.ELECTRONICS, electronics.pid)
            _real_time.hurry(_real_time.LOOP)
            loops: dict[str, Callable[[int], None]] = {
                "empty": lambda _: None,
                name: cycle_of(devices),
            }
            begin = 0
            stale = devices.stale
            while again(turns, rounds, _MOST_TIMES * rounds):
                late = {}
                for which, loop in loops.items():
                    cycles, late[which] = _timed(loop, seconds, begin)
                    begin += cycles + late[which] + 1000
                turns.append(Round(late[name], cycles, late["empty"], cycles))
            stale = devices.stale - stale  # the empty loop reads none
        finally:
            _real_time.relax()
            devices.close()
    finally:
        electronics.terminate()
        electronics.wait()
    empty, label = f"{name}_empty_late_share", _LABELS[name]
    some, n, others, _ = (int(count) for count in np.sum(turns, axis=0))
    return [
        Figure(empty, others / n, "", f"empty loop at 1 kHz beside it, {n} cycles: late"),
        Figure(
            f"{name}_late_share",
            some / n,
            "",
            f"{label}: late",
            empty if others else None,
        ),
        *ratio_figures(turns, f"{name}_late_ratio_low", f"{name}_late_ratio_95", label),
        Figure(f"{name}_stale_share", stale / n, "", f"{label}: stale readings"),
    ]


def _timed(loop: Callable[[int], None], seconds: float, begin: int) -> tuple[int, int]:
    """Run `loop` at 1 kHz; return cycles run and how many of them were late by a period."""
    be_punctual(Realtime(priority=0, lock_memory=False, cpu_latency_us=None))
    clock = RealClock(1 / RATE_HZ)
    clock.start()
    cycle, late = begin, 0
    n = int(seconds * RATE_HZ)
    for _ in range(n):
        clock.wait()
        cycle += 1 + clock.skipped
        late += clock.skipped > 0
        loop(cycle)
    return n, late
