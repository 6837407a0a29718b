"""Clocks that begin again are continued; for other steps back, the error names the remedy."""

from __future__ import annotations

import numpy as np
import pytest

from levid.log.errors import LogError
from levid.log.importing.draft_signals import draft_signals
from levid.log.importing.importer import import_file
from levid.log.reader import read_log

N = 2000
U = np.repeat(np.random.default_rng(1).standard_normal(N // 4), 4)
Y = np.cumsum(U) * 1e-3
HEAD = "levid: signals\n"
COLUMNS = """columns:
  - {column: t, name: t, unit: %s, role: time%s}
  - {column: u, name: u, unit: N, role: input}
  - {column: y, name: y, unit: m, role: output}
"""


def imported(folder, stamps, unit="s", keys="", head=HEAD):
    data, signals, log = folder / "a.csv", folder / "a.yaml", folder / "a.mcap"
    data.write_text(
        "t;u;y\n" + "".join(f"{t};{u};{y}\n" for t, u, y in zip(stamps, U, Y, strict=True))
    )
    signals.write_text(head + COLUMNS % (unit, keys))
    return import_file(data, signals, log)


def times(wrap, start, step, form="%.10g"):
    return [form % t for t in (start + step * np.arange(N)) % wrap]


def of_day(seconds):
    return [
        f"{int(s // 3600) % 24:02}:{int(s // 60) % 60:02}:{s % 60:06.3f}" for s in seconds.tolist()
    ]


@pytest.mark.parametrize(
    ("stamps", "unit", "range_text"),
    [
        (times(86_400, 86_399, 1e-3, "%.3f"), "s", "24 h"),
        (times(86_400e3, 86_399e3, 1, "%.0f"), "ms", "24 h"),
        (of_day(86_399 + 1e-3 * np.arange(N)), "s", "24 h"),
        (times(43_200, 43_199, 1e-3, "%.3f"), "s", "12 h"),
        (times(2**16, 65_000, 1, "%.0f"), "ms", "65.536 s"),
        (times(2**32, 2**32 - 500_000, 1000, "%.0f"), "us", "4294.967296 s"),
        (times(2**32 * 1e-6, 4294.5, 1e-3, "%.6f"), "s", "4294.967296 s"),
        (times(2**24, 16_700_000, 1000, "%.0f"), "us", "16.777216 s"),
        (times(2**16, 60_000, 1000, "%.0f"), "us", "0.065536 s"),
    ],
)
def test_clock_that_begins_again_goes_on(tmp_path, stamps, unit, range_text):
    found = imported(tmp_path, stamps, unit)
    assert found.rate_hz == pytest.approx(1000.0, rel=1e-6)
    assert found.rows == N
    assert any(f"begins again after {range_text}" in note for note in found.notes)
    np.testing.assert_allclose(read_log(found.logs[0][0]).field("y"), Y, atol=1e-12)


@pytest.mark.parametrize(
    ("stamps", "expected_error"),
    [
        (
            [*np.arange(N // 2), *np.arange(N // 2)],
            r"begin again .* import each alone \(rows: \{fi",
        ),
        ([*(5 + np.arange(N)) % 777], r"set wraps: 0\.777 for this column"),
        (np.arange(N)[::-1], "reverse the order of the rows"),
        (np.where(np.arange(N) % 10 == 3, np.arange(N) - 2.5, np.arange(N)), "sort the rows"),
        (np.arange(N) - 150.0 * (np.arange(N) > 900), r"set wraps: 0\.15 for this column"),
        # 16.8 ms, the range of a timer of 24 bit that counts ns, is no range of these stamps.
        (np.arange(N) - 16.0 * (np.arange(N) > 900), r"set back .* set rate_hz .* role other"),
        (np.arange(N) - 1.0 * (np.arange(N) > 900), r"same time .* set rate_hz .* role other"),
    ],
)
def test_remedy_for_time_that_goes_back_is_right(tmp_path, stamps, expected_error):
    with pytest.raises(LogError, match=expected_error):
        imported(tmp_path, 1e-3 * np.asarray(stamps, float), keys="")


def test_stated_range_of_a_clock_is_used(tmp_path):
    found = imported(tmp_path, times(777, 5, 1, "%.0f"), "ms", ", wraps: 777")
    assert found.rate_hz == 1000.0
    assert found.rows == N


@pytest.mark.parametrize("bad", ["700.123", "-9999", ""])
def test_stamp_that_its_neighbours_leave_no_doubt_of_is_replaced(tmp_path, bad):
    stamps = [f"{1e-3 * k:.3f}" for k in range(N)]
    stamps[700] = bad
    if bad != "700.123":
        stamps[1200:1202] = [bad, bad]
    found = imported(tmp_path, stamps)
    assert (found.rate_hz, found.rows) == (1000.0, N)
    assert any(
        note.startswith("wrong or missing time stamps replaced by those between: ")
        for note in found.notes
    )


@pytest.mark.parametrize(
    "rows",
    [
        np.repeat(np.arange(N), 2),
        np.sort(np.append(np.arange(N), [500, 501, 1000])),
        np.concatenate([np.arange(1000), np.arange(936, N)]),  # a buffer written twice
    ],
)
def test_rows_written_twice_are_imported_once(tmp_path, rows):
    data = tmp_path / "a.csv"
    data.write_text("t;u;y\n" + "".join(f"{k / 1000:.3f};{U[k]};{Y[k]}\n" for k in rows.tolist()))
    assert "The time column gives the rate, 1000 Hz." in draft_signals(data).text
    (tmp_path / "a.yaml").write_text(HEAD + COLUMNS % ("s", ""))
    found = import_file(data, tmp_path / "a.yaml", tmp_path / "a.mcap")
    assert (found.rate_hz, found.rows) == (1000.0, N)
    assert f"{len(rows) - N} rows that repeat an earlier row are left out" in found.notes


def test_stamps_with_six_digits_are_accepted(tmp_path):
    """As printf("%g") writes them: to 1 ms before 1000 s, to 10 ms after it."""
    found = imported(tmp_path, [f"{995 + 5e-3 * k:g}" for k in range(N)])
    assert (found.rate_hz, found.rows) == (200.0, N)


def test_stamps_with_offsets_are_utc(tmp_path):
    """Daylight saving time ends: the offset changes from +02:00 to +01:00."""
    stamps = []
    for k in range(N):
        utc = 3599.0 + 1e-3 * k  # seconds after 2024-10-27T00:00:00Z
        offset = 2 if utc < 3600 else 1
        local = utc + 3600 * offset
        stamps.append(
            f"2024-10-27T{int(local // 3600):02}:{int(local // 60) % 60:02}:{local % 60:06.3f}"
            f"+0{offset}:00"
        )
    found = imported(tmp_path, stamps)
    assert found.rows == N
    assert len(found.logs) == 1
    assert "t: times with an offset are converted to UTC" in found.notes


def test_local_times_that_were_set_back_are_asked_about(tmp_path):
    seconds = 10_799.0 + 1e-3 * np.arange(N)
    stamps = [
        f"2024-10-27 {t}" for t in of_day(np.where(seconds < 10_800, seconds, seconds - 3600))
    ]
    with pytest.raises(LogError, match=r"set wraps: 3600 for this column"):
        imported(tmp_path, stamps)
    (tmp_path / "a.mcap").unlink(missing_ok=True)
    assert imported(tmp_path, stamps, keys=", wraps: 3600").rows == N


def test_stated_rate_of_coarse_stamps_is_used(tmp_path):
    stamps = (10_800 + 1e-3 * np.arange(N)).astype(np.float32).astype(float)
    found = imported(tmp_path, stamps, head=HEAD + "rate_hz: 1000\n")
    assert (found.rate_hz, found.rows) == (1000.0, N)


def test_seconds_and_nanoseconds_are_added_and_two_clocks_are_not(tmp_path):
    data, signals = tmp_path / "a.csv", tmp_path / "a.yaml"
    ns = 999_000_000 + 1_000_000 * np.arange(N)
    rows = zip(1_700_000_000 + ns // 10**9, ns % 10**9, ns // 1000, U, Y, strict=True)
    data.write_text(
        "sec,nsec,us,u,y\n" + "".join(",".join(map(str, cells)) + "\n" for cells in rows)
    )
    for column, unit, error in (("nsec", "ns", ""), ("us", "us", "two clocks: column '")):
        signals.write_text(
            HEAD
            + (COLUMNS % ("s", "")).replace("column: t", "column: sec")
            + f"  - {{column: {column}, name: part, unit: {unit}, role: time}}\n"
        )
        if not error:
            found = import_file(data, signals, tmp_path / f"{column}.mcap")
            assert (found.rate_hz, found.rows) == (1000.0, N)
            continue
        with pytest.raises(LogError, match=error):
            import_file(data, signals, tmp_path / f"{column}.mcap")


def test_range_of_a_scaled_counter_is_in_its_counts(tmp_path):
    counts = [f"{t:.0f}" for t in (5e6 + 84_000 * np.arange(N)) % 1e8]
    found = imported(tmp_path, counts, "s", f", scale: {1 / 84e6!r}, wraps: 100000000")
    assert (found.rate_hz, found.rows) == (1000.0, N)
