"""A loop at a fixed rate for a while, counted; and an empty one beside it, in a process of its own.

As a program, `empty_loop.py RATE_HZ CYCLES`, it is that one: it says so when it is ready, begins
with the first line it gets, and tells its counts.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from time import monotonic, sleep
from typing import NamedTuple

from levid.benchmarks.harness import real_time
from levid.benchmarks.harness.child_processes import started
from levid.config.service import Realtime
from levid.daemon.host.real_time_scheduling import apply_realtime, no_collections
from levid.daemon.loop.clock import RealClock

_WARM_UP = 200
"""Cycles of each stretch that do not count: devices that were left alone have to be enabled."""
_ENDS_S, _OUTLASTS_S = 10.0, 2.0
_PUNCTUAL = Realtime(priority=0, cpu_latency_us=0)
"""What the daemon's loop asks for on a machine of its own, but for its priority, which is given
here. Processors that sleep take a moment to wake up, in a virtual machine its host's: an empty loop
waits for that once a cycle, one on a bus as often as both ends hand over."""


class Stretch(NamedTuple):
    """Cycles run, of them late in either sense and with a stale reading; and the last one's.

    real_time: whether it ran first in, first out.
    """

    cycles: int
    begun_late: int
    ended_late: int
    stale: int
    last: int
    real_time: bool = False


def timed(loop: Callable[[int], bool], rate_hz: float, cycles: int, begin: int) -> Stretch:
    """Run `loop`, which says whether its readings are fresh, from cycle `begin` on."""
    apply_realtime(_PUNCTUAL)
    period_s = 1.0 / rate_hz
    clock = RealClock(period_s)
    cycle, begun, ended, stale = begin, 0, 0, 0
    with no_collections():
        clock.start()
        for k in range(-_WARM_UP, cycles):
            late_s = clock.wait()
            began_s = monotonic()
            cycle += 1 + clock.skipped
            fresh = loop(cycle)
            if k >= 0:
                begun += clock.skipped > 0
                ended += late_s + monotonic() - began_s >= period_s
                stale += not fresh
    real_time = os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK == os.SCHED_FIFO
    return Stretch(cycles, begun, ended, stale, cycle, real_time)


def processors() -> tuple[set[int], set[int]]:
    """Return the last processor, a loop's, and the others; all for both where there is one."""
    every = sorted(os.sched_getaffinity(0))
    return ({every[-1]}, set(every[:-1])) if len(every) > 1 else (set(every), set(every))


@contextmanager
def beside(rate_hz: float, cycles: int) -> Iterator[Callable[[], Stretch]]:
    """Run an empty loop on this process's processors; yields what returns its counts, once over."""
    command = [sys.executable, __file__, f"{rate_hz!r}", f"{cycles}"]
    with started(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        assert process.stdin is not None
        assert process.stdout is not None
        process.stdout.readline()
        process.stdin.write(b"go\n")
        process.stdin.flush()

        def counts() -> Stretch:
            told, _ = process.communicate(timeout=_ENDS_S)
            return Stretch(*json.loads(told))

        yield counts


def _run(rate_hz: float, cycles: int) -> None:
    real_time.hurry(real_time.WITNESS)
    print("ready", flush=True)
    sys.stdin.readline()
    found = timed(lambda _: True, rate_hz, cycles, 0)
    # It began a moment before whom it watches: to end takes a kernel some milliseconds.
    sleep(_OUTLASTS_S)
    print(json.dumps(found))


if __name__ == "__main__":
    _run(float(sys.argv[1]), int(sys.argv[2]))
