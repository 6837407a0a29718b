"""Figures of the timing benchmark: what is counted as late, as lost, and as a ratio."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from levid.benchmarks.daemon import loop_jitter_vs_cyclictest
from levid.benchmarks.harness import logged_vs_flown_rows
from levid.benchmarks.harness.logged_vs_flown_rows import Found, compare, found_in
from levid.benchmarks.harness.ratio_interval import Round, ratio_95
from levid.config.rig import load_rig
from levid.config.shipped import shipped
from levid.daemon.ipc.row_ring import NO_LOG
from levid.daemon.ipc.shared_memory import SharedMemory
from levid.log.writer import LogWriter

CYCLICTEST = """# /dev/cpu_dma_latency set to 0us
# Histogram
000009 000002
000150 000003
# Total: 000000005
# Histogram Overflows: 00002
# Thread 0:
"""


def write_log(path: Path, cycles: list[int], late_us: float = 0.0) -> Path:
    """Write a log of these cycles at 10 kHz, each of which takes 50 us."""
    rows = np.zeros(len(cycles), [("cycle", "<u8"), ("lateness_s", "<f4"), ("execution_s", "<f4")])
    rows["cycle"], rows["lateness_s"], rows["execution_s"] = cycles, 1e-6 * late_us, 50e-6
    with LogWriter(path, rows.dtype, rate_hz=1e4, metadata={}, attachments={}) as writer:
        writer.write(rows, rows["cycle"] * np.uint64(100_000))
    return path


def test_overflows_of_cyclictest_count_as_late() -> None:
    turn = loop_jitter_vs_cyclictest.of_cyclictest(CYCLICTEST, 100, 5.0)
    assert (turn.cycles, turn.late) == (7, 5)
    assert np.median(turn.lateness_us) == 150.0
    assert turn.lateness_us.max() == 20_000.0


def test_a_cycle_is_late_if_it_ends_a_period_late(tmp_path: Path) -> None:
    write_log(tmp_path / "a.mcap", [0, 1, 2], late_us=49.0)
    write_log(tmp_path / "b.mcap", [3, 5], late_us=51.0)
    turn = loop_jitter_vs_cyclictest.read_flight(tmp_path, 10_000, 6e-4, np.arange(6))
    assert (turn.cycles, turn.late, turn.found) == (5, 2, Found(missing=1))
    turn.seconds, turn.recorder_s = 5.0, 0.2
    found = {
        figure.key: figure.value
        for figure in loop_jitter_vs_cyclictest.figures(
            "busy", turn, loop_jitter_vs_cyclictest.Turn()
        )
    }
    assert (found["late_share_busy"], found["wrong_rows_busy"]) == (0.4, 1)
    assert found["late_p05_us_busy"] == pytest.approx(51.0)
    assert found["recorder_cpu_busy"] == pytest.approx(0.04)


def test_logged_rows_are_compared_with_flown_rows(tmp_path: Path) -> None:
    flown = np.array([3, 4, 5, 9, 10, 400])
    assert found_in(flown, flown, 0) == Found()
    # The first and last rows are missing, one is logged twice, one was never flown.
    assert found_in(flown, np.array([4, 5, 5, 7, 9, 10]), 1) == Found(2, 1, 1, 1)
    assert found_in(flown, flown[:0], 0).wrong == 6
    path = write_log(tmp_path / "flight.mcap", flown.tolist())
    assert compare(flown, [path]) == Found()
    path.write_bytes(path.read_bytes()[:-40])
    assert compare(flown, [path]).cut == 1


def test_rows_of_this_flight_are_read_from_the_ring(monkeypatch) -> None:
    rig_file = shipped("rigs/loopback.yaml")
    shared = SharedMemory(load_rig(rig_file))
    monkeypatch.setattr(logged_vs_flown_rows, "memory_of", lambda _: shared.fd)
    monkeypatch.setattr(logged_vs_flown_rows.SharedMemory, "close", lambda _: None)
    ring = shared.ring

    def write(n: int, tag: int) -> None:
        for _ in range(n):
            slot = ring.head % ring.capacity
            ring.rows["cycle"][slot], ring.tags[slot] = 2 * ring.head, tag
            ring.head += 1

    write(10, 7)  # an earlier flight
    flown = logged_vs_flown_rows.Flown(0, rig_file)
    for tag in (NO_LOG, 1, 1, 2, NO_LOG):
        write(3000, tag)
        ring.tail = ring.head - 5
        flown.look()
    assert flown.lags == [5] * 5
    np.testing.assert_array_equal(flown.cycles, 2 * np.arange(3010, 12_010))


@pytest.mark.parametrize("rounds", [12, 20])
def test_the_interval_of_a_ratio_covers_the_truth_if_late_cycles_cluster(rounds: int) -> None:
    rng = np.random.default_rng(1)
    inside = []
    for _ in range(500):
        late = 30 * rng.poisson(2.0, (rounds, 2))  # stalls of thirty late cycles
        found = ratio_95([Round(int(a), 10_000, int(b), 10_000) for a, b in late])
        inside.append(found.low < 1.0 < found.high)
    # The standard error is 1 %; Katz's interval alone covers some 28 %.
    assert 0.92 < np.mean(inside) < 0.98
