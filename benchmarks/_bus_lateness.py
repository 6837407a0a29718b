"""How punctual 1 kHz is on each backend: whole loops against an empty one, in turns.

Late is a cycle that begins a period late or more. Loops and electronics run at real-time priority
where that may be had, the empty one too; what carries udp's frames has none, nor can it be given.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from pathlib import Path

import _real_time
from _bus_rigs import RATE_HZ, TIMED, cycle_of, electronics_of, opened, rig_on, rig_text
from _shares import ratio_95
from _table import Figure

from levid.config.service import Realtime
from levid.daemon.clock import RealClock
from levid.daemon.realtime import be_punctual

_LABELS = {
    "canfd": "CAN FD on local sockets",
    "canfd_udp": "CAN FD by udp_multicast",
    "serial": "serial on a pty",
}


def lateness_figures(seconds: float, rounds: int) -> list[Figure]:
    """Return the share of late cycles of each backend and of the empty loop in turns with it.

    Also the upper end of the 95 % interval of their ratio, and the share of stale readings.
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
    late, n = {"empty": 0, name: 0}, 0
    try:
        devices = opened(rig_on(name, folder), folder)
        try:
            _real_time.hurry(_real_time.ELECTRONICS, electronics.pid)
            _real_time.hurry(_real_time.LOOP)
            loops: dict[str, Callable[[int], None]] = {
                "empty": lambda _: None,
                name: cycle_of(devices),
            }
            begin = stale = 0
            for _ in range(rounds):
                for which, loop in loops.items():
                    before = devices.stale
                    cycles, missed = _timed(loop, seconds, begin)
                    begin += cycles + missed + 1000
                    late[which] += missed
                    if which == name:
                        stale += devices.stale - before
                        n += cycles
        finally:
            _real_time.relax()
            devices.close()
    finally:
        electronics.terminate()
        electronics.wait()
    empty, label = f"{name}_empty_late_share", _LABELS[name]
    ratio = ratio_95(late[name], n, late["empty"], n)[1]
    return [
        Figure(empty, late["empty"] / n, "", f"empty loop at 1 kHz beside it, {n} cycles: late"),
        Figure(
            f"{name}_late_share",
            late[name] / n,
            "",
            f"{label}: late",
            empty if late["empty"] else None,
        ),
        Figure(f"{name}_late_ratio_95", ratio, "", f"{label}: ratio of the two, 95 % bound"),
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
