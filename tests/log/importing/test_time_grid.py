"""Test the uniform grid of time stamps: rate, jitter, late and rounded stamps, missing rows."""

from __future__ import annotations

import numpy as np
import pytest

from levid.log.errors import LogError
from levid.log.importing.time_grid import fit_grid


def grid(time_s):
    return fit_grid("t", np.asarray(time_s, float), np.arange(len(time_s)))


@pytest.mark.parametrize("rate_hz", [1.0, 48.0, 610.3515625, 10_000.0])
def test_rate_of_exact_stamps(rate_hz):
    found = grid(1e5 + np.arange(3000) / rate_hz)
    # A clock of 1e5 s in float64 has a resolution of 1e-11 s.
    assert 1.0 / found.period_s == pytest.approx(rate_hz, rel=1e-5)
    assert found.regular
    (part,) = found.parts
    np.testing.assert_array_equal(part.place, np.arange(3000))


def test_round_rate_is_exact():
    assert 1.0 / grid(np.arange(500) * 0.001 + 1e-6 * np.sin(np.arange(500))).period_s == 1000.0


def test_rounded_stamps_are_accepted():
    time_s = np.arange(2000) / 610.35
    found = grid(np.round(time_s, 3))
    assert found.regular
    assert 1.0 / found.period_s == pytest.approx(610.35, rel=1e-4)
    (part,) = found.parts
    np.testing.assert_array_equal(part.place, np.arange(2000))
    assert found.notes() == ["time stamps are rounded to 0.001 s, which is accepted"]


def test_missing_rows_shift_all_rows_after_them():
    kept = np.delete(np.arange(1000), [100, 500, 501, 502])
    (part,) = grid(kept * 1e-3).parts
    np.testing.assert_array_equal(part.place, kept)


def test_long_gap_splits_the_rows():
    kept = np.delete(np.arange(1000), np.arange(300, 320))
    first, second = grid(kept * 1e-3).parts
    np.testing.assert_array_equal(first.place, np.arange(300))
    np.testing.assert_array_equal(second.place, np.arange(320, 1000))


def test_late_stamps_do_not_shift_the_rows_after_them():
    time_s = np.arange(1000) * 1e-3
    time_s[400:403] = [0.4025, 0.40251, 0.40252]
    found = grid(time_s)
    assert found.regular
    np.testing.assert_array_equal(found.parts[0].place, np.arange(1000))
    assert np.flatnonzero(found.off_grid).tolist() == [400, 401, 402]


def test_jitter_beyond_a_tenth_of_the_period_is_irregular():
    rng = np.random.default_rng(1)
    time_s = np.arange(1000) * 1e-3
    assert grid(time_s + 0.08e-3 * rng.uniform(-1, 1, 1000)).regular
    assert not grid(time_s + 0.3e-3 * rng.uniform(-1, 1, 1000)).regular
    assert not grid(np.cumsum(rng.uniform(0.5e-3, 1.5e-3, 1000))).regular


@pytest.mark.parametrize(
    ("time_s", "expected_error"),
    [
        ([0.0, 1.0], "expected at least 3 times, found 2"),
        ([0.0, 0.0, 0.0, 1.0], "the same time and other values in rows 0 and 1 and 1 more"),
        ([0.0, 1.1, 2.2, 2.2, 3.3, 4.4], "rows 2 and 3; if all rows were sampled regularly"),
    ],
)
def test_times_that_do_not_increase_are_reported(time_s, expected_error):
    with pytest.raises(LogError) as caught:
        grid(time_s)
    assert expected_error in str(caught.value)


@pytest.mark.parametrize(("start_s", "rate_hz"), [(10_800.0, 1000.0), (86_400.0, 100.0)])
def test_stamps_in_32_bit_give_the_rate_of_the_whole_record(start_s, rate_hz):
    time_s = (start_s + np.arange(20_000) / rate_hz).astype(np.float32).astype(float)
    found = grid(time_s)
    assert 1.0 / found.period_s == pytest.approx(rate_hz, rel=1e-6)
    (part,) = found.parts
    np.testing.assert_array_equal(part.place, np.arange(20_000))
    assert found.notes() == [
        f"time stamps are rounded to {found.resolution_s:g} s, which is accepted"
    ]


def test_missing_rows_between_coarse_stamps_are_found():
    kept = np.delete(np.arange(20_000), [5000, 12_000])
    time_s = (10_800.0 + kept * 1e-3).astype(np.float32).astype(float)
    found = grid(time_s)
    assert 1.0 / found.period_s == pytest.approx(1000.0, rel=1e-4)
    (part,) = found.parts
    # Where a row is missing is known within about 30 rows: the stamps are rounded to a period.
    wrong = np.flatnonzero(part.place != kept)
    assert len(wrong) < 100


def test_ticks_of_a_system_timer_are_accepted():
    # Windows counts in 1/64 s; a logger with 10 ms reads equal stamps.
    time_s = np.floor(np.arange(3000) * 0.010 * 64) / 64
    found = grid(time_s)
    assert 1.0 / found.period_s == pytest.approx(100.0, rel=1e-3)
    np.testing.assert_array_equal(found.parts[0].place, np.arange(3000))


def test_stated_rate_decides_between_grids_that_the_stamps_allow():
    time_s = np.floor(np.arange(3000) * 1e-3 / 0.1) * 0.1  # stamps of blocks of 100 rows
    found = fit_grid("t", time_s, np.arange(3000), 1e-3)
    assert found.period_s == pytest.approx(1e-3, rel=1e-3)
    np.testing.assert_array_equal(found.parts[0].place, np.arange(3000))
