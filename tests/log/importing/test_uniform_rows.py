"""Test rows at a constant rate: missing values filled in or cut out, irregular rows resampled."""

from __future__ import annotations

import numpy as np
import pytest

from levid.log.errors import LogError
from levid.log.importing.signals_yaml import SignalsFile
from levid.log.importing.uniform_rows import uniform_rows

N = 1000
TIME_S = np.arange(N) * 1e-3
SMOOTH = np.sin(2 * np.pi * 7.0 * TIME_S)
WHITE = np.random.default_rng(1).standard_normal(N)


def signals(*, time=True, **keys):
    columns = [
        {"column": 0, "name": "u", "unit": "V", "role": "input"},
        {"column": 1, "name": "y", "unit": "m", "role": "output"},
        {"column": 2, "name": "z", "unit": "m", "role": "other"},
    ]
    if time:
        columns.append({"column": 3, "name": "t", "unit": "ms", "role": "time"})
    return SignalsFile.model_validate({"levid": "signals", "columns": columns, **keys})


def rows_of(u, y, z=None, time_s=TIME_S, **keys):
    z = np.zeros(len(u)) if z is None else z
    return uniform_rows("data", signals(**keys), [u, y, z, 1e3 * time_s])


def with_nan(values, *rows):
    values = values.copy()
    values[list(rows)] = np.nan
    return values


def test_complete_rows_stay_as_they_are():
    found = rows_of(WHITE, SMOOTH)
    (part,) = found.parts
    assert found.rate_hz == 1000.0
    assert found.remarks == ()
    np.testing.assert_array_equal(part.values[:, :2], np.stack([WHITE, SMOOTH], axis=1))


def test_short_runs_of_a_smooth_signal_are_filled_in():
    found = rows_of(WHITE, with_nan(SMOOTH, 100, 300, 301, 302))
    (part,) = found.parts
    # Cubic interpolation over four steps h: h^4 (2 pi 7 Hz)^4 / 24 = 4e-5.
    assert np.abs(part.values[:, 1] - SMOOTH).max() < 1e-4
    (remark,) = found.remarks
    assert remark.startswith("4 missing values of y filled in (cubic; error about ")


def test_missing_values_of_white_noise_cut_the_data():
    found = rows_of(with_nan(WHITE, 400), SMOOTH)
    assert [(part.place, len(part.values)) for part in found.parts] == [(0, 400), (401, 599)]
    (remark,) = found.remarks
    assert "(row 400; more than 5 in a row, at an end, or in a signal that changes" in remark


def test_missing_rows_in_the_time_column_are_found():
    kept = np.delete(np.arange(N), [250, 600, 601])
    found = rows_of(SMOOTH[kept], SMOOTH[kept], time_s=TIME_S[kept])
    (part,) = found.parts
    assert np.abs(part.values[:, 1] - SMOOTH).max() < 1e-4
    np.testing.assert_allclose(part.values[:, 3], 1e3 * TIME_S, atol=1e-9)


def test_missing_values_at_the_ends_are_cut_off():
    (part,) = rows_of(WHITE, with_nan(SMOOTH, 0, 1, N - 1)).parts
    assert (part.place, len(part.values)) == (2, N - 3)


def test_missing_values_of_unused_columns_stay_missing():
    (part,) = rows_of(WHITE, SMOOTH, with_nan(SMOOTH, 5, 6)).parts
    assert np.flatnonzero(np.isnan(part.values[:, 2])).tolist() == [5, 6]


def test_short_parts_are_left_out():
    found = rows_of(with_nan(WHITE, 40, 500), SMOOTH)
    assert [part.place for part in found.parts] == [41, 501]
    assert "1 short part between missing values, 40 rows, left out" in found.remarks


def test_too_many_missing_values_are_refused_with_a_remedy():
    # Every tenth value would have to be filled in.
    with pytest.raises(LogError, match="found 1000 of 1000 rows in such parts and 99 rows to fill"):
        rows_of(WHITE, with_nan(SMOOTH, *range(10, N, 10)))
    # Every part has 29 rows.
    with pytest.raises(LogError, match=r"found 0 of 1000 .*missing: row 30, row 60, row 90 and 30"):
        rows_of(with_nan(WHITE, *range(30, N, 30)), SMOOTH, time=False, rate_hz=1000.0)


def test_rate_that_contradicts_the_time_column_is_refused():
    assert rows_of(WHITE, SMOOTH, rate_hz=1001.0).rate_hz == 1001.0  # clocks drift
    with pytest.raises(LogError, match=r"as rate_hz: 500 says, found one every 0\.001 s"):
        rows_of(WHITE, SMOOTH, rate_hz=500.0)


IRREGULAR_S = np.cumsum(np.random.default_rng(2).uniform(0.5e-3, 1.5e-3, N))


def test_irregular_rows_are_refused_with_the_key_to_set():
    with pytest.raises(LogError, match=r"irregular time stamps: .* set resample: true"):
        rows_of(WHITE, SMOOTH, time_s=IRREGULAR_S)


def test_resampled_output_is_accurate_and_input_keeps_its_area():
    y = np.sin(2 * np.pi * 7.0 * IRREGULAR_S)
    found = rows_of(WHITE, y, time_s=IRREGULAR_S, resample=True, rate_hz=500.0)
    (part,) = found.parts
    time_s = IRREGULAR_S[0] + np.arange(len(part.values)) / 500.0
    # Cubic interpolation over steps of 1.5 ms: h^4 (2 pi 7 Hz)^4 / 384 = 5e-8; more at the ends.
    assert np.abs(part.values[2:-2, 1] - np.sin(2 * np.pi * 7.0 * time_s[2:-2])).max() < 1e-6
    area = np.sum(WHITE[:-1] * np.diff(IRREGULAR_S))
    # The last period is not complete.
    assert np.sum(part.values[:-1, 0]) / 500.0 == pytest.approx(area, abs=2e-3 * WHITE.max())
    np.testing.assert_allclose(part.values[:, 3], 1e3 * time_s, atol=1e-6)
    assert found.remarks[1] == "u: resampled to the mean of the held input in each period"


def test_long_steps_between_irregular_rows_split_the_data():
    time_s = IRREGULAR_S + np.where(np.arange(N) >= 600, 0.1, 0.0)
    found = rows_of(WHITE, SMOOTH, time_s=time_s, resample=True)
    assert len(found.parts) == 2
    assert found.parts[1].place - found.parts[0].place - len(found.parts[0].values) > 100
    with pytest.raises(LogError, match="rate_hz: expected at most 20 periods for each row"):
        rows_of(WHITE, SMOOTH, time_s=time_s, resample=True, rate_hz=1e6)


def test_columns_with_times_of_their_own_are_resampled_each():
    """Two messages of a bus in one table, where each row has the values of one of them."""
    time_s = np.sort(np.concatenate([TIME_S, TIME_S + 0.3e-3]))
    first = np.arange(2 * N) % 2 == 0
    u = np.where(first, np.repeat(WHITE, 2), np.nan)
    y = np.where(first, np.nan, np.sin(2 * np.pi * 7.0 * time_s))
    with pytest.raises(LogError, match="set resample: true"):
        rows_of(u, y, time_s=time_s)
    found = rows_of(u, y, time_s=time_s, resample=True)
    (part,) = found.parts
    assert found.rate_hz == 1000.0
    # The values of u are held from the first row with a value of both on.
    np.testing.assert_allclose(part.values[:, 0], WHITE[part.place : part.place + len(part.values)])
    at_s = (part.place + np.arange(len(part.values))) / 1000.0
    assert np.abs(part.values[:, 1] - np.sin(2 * np.pi * 7.0 * at_s)).max() < 1e-5
    assert f"y: {N} of {2 * N} rows have no value of it" in found.remarks
