"""Test which rows of a log remain single samples in charts."""

from __future__ import annotations

import numpy as np

from levid.log.signals import cycle_dtype
from levid.report.session.event_windows import event_windows


def test_windows_are_around_start_fault_state_and_saturation():
    rows = np.zeros(20_000, cycle_dtype(9, 9))
    rows["state"][5_000:] = 3
    rows["saturated"][9_000:9_100] = 2
    rows["fault"][15_000:] = 7
    windows = event_windows(rows, 1000.0, 10_000)
    assert windows == [(0, 200), (4_950, 5_200), (8_950, 9_200), (14_950, 15_200)]


def test_many_events_share_the_rows():
    rows = np.zeros(100_000, cycle_dtype(9, 9))
    rows["saturated"][::100] = 1
    windows = event_windows(rows, 1000.0, 480)
    assert len(windows) <= 24
    assert sum(end - start for start, end in windows) <= 480
    assert windows[0][0] == 0
