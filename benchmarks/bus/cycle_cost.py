"""Measure the cost of a cycle on each backend and of its parts, and its late and stale cycles.

A cycle is that of the devices, readings in and zero force out, without control and recording. The
emulated electronics are a separate process. The full run takes six minutes.
"""

from __future__ import annotations

import contextlib
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np

from levid.benchmarks.bus.can_codec_speed import codec_figures
from levid.benchmarks.bus.rig_on_each_backend import (
    LABELS,
    RATE_HZ,
    cycle_of,
    electronics_on,
    opened,
    rig_on,
    rig_text,
)
from levid.benchmarks.bus.serial_transaction import serial_figures
from levid.benchmarks.harness import benchmark_runner, real_time
from levid.benchmarks.harness.benchmark_runner import Figure
from levid.daemon.host.real_time_scheduling import no_collections
from levid.daemon.loop.clock import RealClock
from levid.drivers.base import DriverError

_WARM_UP = 100


class Cycles(NamedTuple):
    """Times in s of the cycles without a stale reading; shares of late and of stale cycles."""

    times_s: list[float]
    late: float
    stale: float


def measure(quick: bool) -> list[Figure]:
    calls, cycles = (500, 2_000) if quick else (5_000, 60_000)
    return [*codec_figures(calls), *serial_figures(calls), *cycle_figures(cycles)]


def cycle_figures(n: int) -> list[Figure]:
    """Return the figures of `n` cycles at 1 kHz on each backend."""
    figures: list[Figure] = []
    for name, label in LABELS.items():
        try:
            found = _on_backend(name, n)
        except DriverError as error:
            print(f"{label}: no figure: {error}", file=sys.stderr)
            continue
        if found.times_s:
            median_us = 1e6 * float(np.median(found.times_s))
            figures.append(Figure(f"{name}_cycle_us", median_us, "us", f"{label}: a cycle, median"))
        figures += [
            Figure(f"{name}_late", found.late, "", f"{label}: cycles a period late or more"),
            Figure(f"{name}_stale", found.stale, "", f"{label}: cycles with a stale reading"),
        ]
    return figures


def run_cycles(cycle: Callable[[int], bool], n: int) -> Cycles:
    """Run `cycle`, which returns whether no reading is stale, at 1 kHz."""
    times_s, stale, late, number = [], 0, 0, 0
    clock = RealClock(1 / RATE_HZ)
    with no_collections():
        clock.start()
        for k in range(-_WARM_UP, n):
            clock.wait()
            number += 1 + clock.skipped
            start_s = time.perf_counter()
            fresh = cycle(number)
            if k >= 0:
                late += clock.skipped > 0
                stale += not fresh
                if fresh:
                    times_s.append(time.perf_counter() - start_s)
    return Cycles(times_s, late / n, stale / n)


def _on_backend(name: str, n: int) -> Cycles:
    with contextlib.ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        path = folder / "rig.yaml"
        path.write_text(rig_text(name, folder))
        electronics = None if name == "loopback" else stack.enter_context(electronics_on(path))
        devices = stack.enter_context(opened(rig_on(name, folder), folder))
        if electronics is not None:
            real_time.hurry(real_time.ELECTRONICS, electronics.pid)
        stack.callback(real_time.relax)
        real_time.hurry(real_time.LOOP)
        return run_cycles(cycle_of(devices), n)


if __name__ == "__main__":
    benchmark_runner.run("Cycle on each backend", measure)
