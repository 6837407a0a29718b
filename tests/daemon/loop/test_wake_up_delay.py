"""Test the wake-up delay that the clock measures, and its histogram."""

from __future__ import annotations

import numpy as np
import pytest
from loop_with_scripted_clock import ScriptedLoop

from levid.daemon.ipc.timing_histograms import WakeUps
from levid.daemon.loop import clock as clock_module
from levid.daemon.loop.clock import RealClock
from levid.daemon.loop.count_cycle_times import count_wake_up


def counted(times_ns: np.ndarray) -> WakeUps:
    found = WakeUps(memoryview(bytearray(WakeUps.SIZE)))
    for ns in times_ns:
        count_wake_up(found.counts, int(ns))
    return found


def test_quantiles_are_numpy_s_to_the_width_of_a_bin() -> None:
    times_ns = np.random.default_rng(1).lognormal(np.log(14e3), 0.7, 20_000).astype(np.int64)
    found = counted(times_ns).figures()
    for key, share in (("p50", 0.5), ("p99", 0.99), ("p99.9", 0.999)):
        # A bin is a thirty-second wide at most; its upper edge is told.
        true_us = np.quantile(times_ns, share) * 1e-3
        assert true_us * 0.99 <= found[key] <= true_us * 1.04
    assert found["max"] == pytest.approx(times_ns.max() * 1e-3)


def test_each_time_is_in_the_bin_of_its_edges() -> None:
    for ns in (1, 2, 3, 999, 14_000, 1_000_000_007):
        (at,) = np.flatnonzero(counted(np.array([ns])).counts[:-1])
        assert WakeUps.edges_us()[at] <= ns * 1e-3 < WakeUps.edges_us()[at + 1]
    assert counted(np.array([1 << 60])).figures()["max"] == pytest.approx((1 << 60) * 1e-3)


def test_cycle_that_did_not_sleep_woke_up_at_no_time() -> None:
    assert counted(np.array([-1, -1])).figures() == {"p50": 0.0, "p99": 0.0, "p99.9": 0.0, "max": 0}


def test_clock_tells_the_wake_up_and_not_what_is_left_after_its_spin(monkeypatch) -> None:
    now_ns, slept_s = 0, []

    def monotonic_ns() -> int:
        nonlocal now_ns
        now_ns += 100  # what a look at the clock takes
        return now_ns

    def sleep(seconds: float) -> None:
        nonlocal now_ns
        slept_s.append(seconds)
        now_ns += round(1e9 * seconds) + 14_000  # the kernel's part

    monkeypatch.setattr(clock_module.time, "monotonic_ns", monotonic_ns)
    monkeypatch.setattr(clock_module.time, "sleep", sleep)
    clock = RealClock(1e-3)
    clock.start()
    clock.wait()
    assert clock.overslept_ns == -1  # cycle 0 begins at once
    late_s = clock.wait()
    assert clock.overslept_ns == 14_100
    assert slept_s == [pytest.approx(0.95e-3, abs=1e-6)]
    assert late_s <= 100e-9
    now_ns += 5_000_000  # a cycle that took too long
    clock.wait()
    assert clock.overslept_ns == -1
    assert clock.skipped == 4


def test_loop_counts_the_wake_ups_of_its_clock() -> None:
    flight = ScriptedLoop()

    def script(n: int) -> None:
        flight.clock.overslept_ns = -1 if n % 2 else 20_000

    flight.run(script, 400)
    counts = flight.shared.wake_ups.counts
    assert counts[:-1].sum() == 200
    assert flight.shared.wake_ups.figures()["p50"] == 20.0
