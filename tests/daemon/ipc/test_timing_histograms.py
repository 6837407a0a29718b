"""Test the timing histograms against quantiles of numpy, and the causes of late cycles."""

import numpy as np
import pytest

from levid.daemon.ipc.timing_histograms import Time, Timing
from levid.daemon.loop.count_cycle_times import account, memory_of

PERIOD_NS = 1e6


def counted(cycles: np.ndarray) -> Timing:
    """Count cycles (n, 5): lateness, drivers, control, writing in ns, periods skipped."""
    timing, before = Timing(memoryview(bytearray(Timing.SIZE))), memory_of(PERIOD_NS)
    for late, drivers, control, writing, skipped in cycles:
        account(timing.counts, late, drivers, control, writing, int(skipped), before)
    return timing


def test_quantiles_are_numpy_s_to_the_width_of_a_bin() -> None:
    rng = np.random.default_rng(1)
    cycles = np.zeros((20_000, 5))
    cycles[:, :4] = rng.lognormal(np.log([3e3, 20e3, 5e3, 1e3]), 0.7, (20_000, 4)).round()
    figures = counted(cycles).figures()
    execution = cycles[:, 1:4].sum(axis=1)
    for name, values in (("lateness", cycles[:, 0]), ("execution", execution)):
        found = figures[f"{name}_us"]
        for key, share in (("p50", 0.5), ("p99", 0.99), ("p99.9", 0.999)):
            # A bin is at most a quarter wide; its upper edge is told.
            true = np.quantile(values, share) * 1e-3
            assert true * 0.99 <= found[key] <= true * 1.26
        assert found["max"] == pytest.approx(values.max() * 1e-3)
    assert figures["late_by"] == {"wake_up": 0, "drivers": 0, "control": 0}


@pytest.mark.parametrize(
    ("before", "cause"),
    [
        ((0, 10e3, 5e3, 1e3), "wake_up"),
        ((0, 1.2e6, 5e3, 1e3), "drivers"),
        ((0, 10e3, 1.2e6, 1e3), "control"),
        ((0, 10e3, 20e3, 1.2e6), "drivers"),  # an amplifier that blocks when it is written to
        ((0.9e6, 300e3, 5e3, 1e3), "drivers"),  # it began late itself, and so ended late
    ],
)
def test_late_cycle_is_put_down_to_its_cause(before: tuple[float, ...], cause: str) -> None:
    timing = counted(np.array([[*before, 0], [1.3e6, 10e3, 5e3, 1e3, 1]]))
    late_by = timing.figures()["late_by"]
    assert late_by.pop(cause) == 1
    assert not any(late_by.values())


@pytest.mark.parametrize(
    ("before", "skipped", "cause"),
    [
        ((1.3e6, 10e3, 5e3, 1e3), 1, "wake_up"),  # it had 0.7 ms left, and took less
        ((1.3e6, 10e3, 0.8e6, 1e3), 1, "control"),
        ((2.9e6, 150e3, 5e3, 1e3), 2, "drivers"),  # 0.1 ms left
    ],
)
def test_second_late_cycle_in_a_row_is_put_down_to_its_own_cause(
    before: tuple[float, ...], skipped: int, cause: str
) -> None:
    quick = (0, 10e3, 5e3, 1e3, 0)
    timing = counted(np.array([quick, [*before, skipped], [1.3e6, 10e3, 5e3, 1e3, 1]]))
    late_by = timing.figures()["late_by"]
    late_by["wake_up"] -= 1  # the first: before it all was quick
    assert late_by.pop(cause) == 1
    assert not any(late_by.values())


def test_nothing_measured_is_zero_and_what_is_huge_has_a_bin() -> None:
    assert counted(np.zeros((0, 5))).figures()["lateness_us"]["max"] == 0.0
    figures = counted(np.array([[1e15, 0, 0, 0, 0]])).figures()
    assert figures["lateness_us"]["max"] == pytest.approx(1e12)
    assert set(figures) == {f"{t.name.lower()}_us" for t in Time} | {"late_by"}
