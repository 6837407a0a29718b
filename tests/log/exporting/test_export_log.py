"""Test exported tables with independent readers, the round trip, and memory."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.io
import scipy.signal
from measured_command import levid as measured

from levid.log.errors import LogError
from levid.log.exporting.export_log import ExportOptions, export_log
from levid.log.reader import Log, read_log
from levid.log.signals import SIGNALS, cycle_dtype
from levid.log.writer import LogWriter

UNITS = {s.name: s.unit for s in SIGNALS}
RATE_HZ = 1000.0


def write_log(path: Path, rows: int, begin_s: float = 2.0) -> Path:
    """Write a log of the rig with random values in every field, 3 coils and 4 sensors."""
    dtype = cycle_dtype(3, 4)
    rng = np.random.default_rng(3)
    with LogWriter(
        path, dtype, rate_hz=RATE_HZ, metadata={"session": "made", "note": "21 °C"}, attachments={}
    ) as log:
        for begin in range(0, rows, 100_000):
            part = np.zeros(min(100_000, rows - begin), dtype)
            for name in dtype.names:
                field = part[name]
                if field.dtype.kind == "f":
                    part[name] = 1e-4 * rng.standard_normal(field.shape)
            part["cycle"] = begin + np.arange(len(part))
            part["time_s"] = begin_s + part["cycle"] / RATE_HZ
            log.write(part, np.uint64(10**18) + (part["time_s"] * 1e9).astype(np.uint64))
    return path


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Log:
    return read_log(write_log(tmp_path_factory.mktemp("export") / "made.mcap", 20_000))


def flat(log: Log) -> dict[str, np.ndarray]:
    """Return all columns of a log by the name in a flat table."""
    found = {}
    for name in log.rows.dtype.names or ():
        values = log.rows[name]
        found |= (
            {name: values}
            if values.ndim == 1
            else {f"{name}_{i}": column for i, column in enumerate(values.T)}
        )
    return found


def test_parquet_has_all_rows_with_units(log: Log, tmp_path: Path) -> None:
    duckdb = pytest.importorskip("duckdb")
    parquet = pytest.importorskip("pyarrow.parquet")
    export_log(log.path, tmp_path / "t.parquet")
    table = parquet.read_table(tmp_path / "t.parquet")
    assert set(table.column_names) == set(flat(log))
    for name, values in flat(log).items():
        column = table.column(name).to_numpy()
        assert column.dtype == values.dtype
        np.testing.assert_array_equal(column, values)
    for field in table.schema:
        stem = field.name if field.name in UNITS else field.name.rpartition("_")[0]
        assert field.metadata[b"unit"].decode() == UNITS[stem]
    assert table.schema.metadata[b"note"].decode() == "21 °C"
    query = f"select count(*), max(gap_m_2) from '{tmp_path}/t.parquet' where time_s >= 10"
    late = log.rows[log.rows["time_s"] >= 10]
    assert duckdb.sql(query).fetchall() == [(len(late), late["gap_m"][:, 2].max())]


def test_csv_is_what_pandas_and_numpy_read(log: Log, tmp_path: Path) -> None:
    pandas = pytest.importorskip("pandas")
    export_log(log.path, tmp_path / "t.csv")
    frame = pandas.read_csv(tmp_path / "t.csv")
    table = np.genfromtxt(tmp_path / "t.csv", delimiter=",", names=True)
    for name, values in flat(log).items():
        for read in (frame[name].to_numpy(), table[name]):
            np.testing.assert_array_equal(read.astype(values.dtype), values)


def test_mat_keeps_arrays_types_and_units(log: Log, tmp_path: Path) -> None:
    export_log(log.path, tmp_path / "t.mat")
    found = scipy.io.loadmat(tmp_path / "t.mat", squeeze_me=True)
    for name in log.rows.dtype.names or ():
        assert found[name].dtype == log.rows[name].dtype
        np.testing.assert_array_equal(found[name], log.rows[name])
    assert found["units"]["gap_m"].item() == "m"
    assert found["metadata"]["session"].item() == "made"


def test_npz_keeps_arrays_types_and_units(log: Log, tmp_path: Path) -> None:
    export_log(log.path, tmp_path / "t.npz")
    found = np.load(tmp_path / "t.npz")
    for name in log.rows.dtype.names or ():
        assert found[name].dtype == log.rows[name].dtype
        np.testing.assert_array_equal(found[name], log.rows[name])
    assert dict(found["units"])["v_psi_n_m"] == "N m"
    assert dict(found["metadata"])["note"] == "21 °C"


@pytest.mark.parametrize("kind", ["csv", "npz", "mat"])
def test_exported_columns_and_times_are_those_asked_for(
    log: Log, tmp_path: Path, kind: str
) -> None:
    options = ExportOptions(("pose", "gap_m_3"), begin_s=3.0, end_s=3.999)
    found = export_log(log.path, tmp_path / f"t.{kind}", options)
    assert [c.name for c in found.columns] == ["time_s", "psi_rad", "theta_rad", "z_m", "gap_m_3"]
    assert found.rows == 1000
    if kind == "npz":
        part = log.rows[1000:2000]
        np.testing.assert_array_equal(np.load(found.path)["gap_m_3"], part["gap_m"][:, 3])


def test_errors_name_what_there_is(log: Log, tmp_path: Path) -> None:
    out = tmp_path / "t.csv"
    for names, text in ((("gapm",), "did you mean gap_m"), (("gap_m_9",), "elements 0 to 3")):
        with pytest.raises(LogError, match=text):
            export_log(log.path, out, ExportOptions(names))
    with pytest.raises(LogError, match=r"expected a part of 2 to 21\.999 s"):
        export_log(log.path, out, ExportOptions(begin_s=50.0))
    with pytest.raises(LogError, match=r"\.csv, \.parquet, \.mat or \.npz"):
        export_log(log.path, tmp_path / "t.xlsx")
    assert list(tmp_path.iterdir()) == []
    export_log(log.path, out)
    with pytest.raises(LogError, match="exists"):
        export_log(log.path, out)
    export_log(log.path, out, ExportOptions(overwrite=True))


def test_import_of_an_exported_csv_gives_the_numbers_back(
    log: Log, tmp_path: Path, levid: Callable[..., Any]
) -> None:
    assert levid("export", log.path, "-o", tmp_path / "t.csv").code == 0
    arguments = (tmp_path / "t.csv", "--signals", tmp_path / "t.signals.yaml")
    code, _, err = levid("import", *arguments, "-o", tmp_path / "back.mcap")
    assert code == 0, err
    back = read_log(tmp_path / "back.mcap")
    assert back.rate_hz == log.rate_hz
    names = [name for name in flat(log) if name not in ("time_s", "cycle")]
    for name in names:
        values = flat(log)[name]
        np.testing.assert_array_equal(back.rows[name].astype(values.dtype), values)
    np.testing.assert_allclose(back.rows["time_s"], log.rows["time_s"], rtol=0, atol=1e-9)
    # What is imported is exported with its roles.
    again = export_log(back.path, tmp_path / "again.csv", ExportOptions(("outputs",)))
    assert [c.name for c in again.columns] == ["time_s", "psi_rad", "theta_rad", "z_m"]


def test_every_removes_what_would_alias(tmp_path: Path) -> None:
    # 3 Hz passes, 48 Hz would appear as 2 Hz at 50 Hz.
    dtype = np.dtype([("time_s", "<f8"), ("slow", "<f8"), ("fast", "<f8"), ("fault", "u1")])
    rows = np.zeros(20_000, dtype)
    t = rows["time_s"] = np.arange(20_000) / RATE_HZ
    rows["slow"], rows["fast"] = np.sin(2 * np.pi * 3 * t), np.sin(2 * np.pi * 48 * t)
    rows["fault"][12_345] = 7
    path = tmp_path / "tones.mcap"
    with LogWriter(path, dtype, rate_hz=RATE_HZ, metadata={}, attachments={}) as log:
        log.write(rows, (t * 1e9).astype(np.uint64))
    found = export_log(path, tmp_path / "t.npz", ExportOptions(every=20))
    table = np.load(found.path)
    assert found.rows == 1000
    inner = slice(30, -30)  # the filter reaches 22 new rows
    np.testing.assert_allclose(table["time_s"], t[::20])
    np.testing.assert_allclose(table["slow"][inner], rows["slow"][::20][inner], atol=1e-3)
    assert np.abs(table["fast"][inner]).max() < 10 ** (-70 / 20)
    assert table["fault"].max() == 7
    assert any("removed above 25 Hz" in note for note in found.notes)


def test_every_is_a_filter_then_every_nth_row(log: Log, tmp_path: Path) -> None:
    from levid.log.exporting.decimation import low_pass

    table = np.load(export_log(log.path, tmp_path / "t.npz", ExportOptions(every=7)).path)
    x = log.rows["gap_m"][:, 1].astype(float)
    taps = low_pass(7)
    half = len(taps) // 2
    padded = np.concatenate([np.full(half, x[0]), x, np.full(half, x[-1])])
    expected = scipy.signal.fftconvolve(padded, taps, "valid")[::7]
    np.testing.assert_allclose(table["gap_m"][:, 1], expected, rtol=0, atol=1e-9)


def test_memory_does_not_grow_with_the_log(tmp_path: Path) -> None:
    peaks = {}
    for rows in (40_000, 140_000):
        path = write_log(tmp_path / f"{rows}.mcap", rows)
        for kind in ("npz", "mat"):
            code, text, peaks[kind, rows], _ = measured(
                "export", path, "-o", tmp_path / f"{rows}.{kind}"
            )
            assert code == 0, text
    # The rows that the longer log has more take 24 MB.
    for kind in ("npz", "mat"):
        assert peaks[kind, 140_000] < peaks[kind, 40_000] + 12e6, peaks


def test_a_folder_of_tables(log: Log, tmp_path: Path, levid: Callable[..., Any]) -> None:
    other = write_log(tmp_path / "other.mcap", 100)
    code, out, _ = levid("export", log.path, other, "--format", "npz", "-o", tmp_path / "tables")
    assert code == 0
    assert sorted(p.name for p in (tmp_path / "tables").iterdir()) == ["made.npz", "other.npz"]
    assert "other.npz: 100 rows" in out
    assert levid("export", log.path, other, "-o", tmp_path / "one.csv").code == 2


def test_info_in_words_and_json(log: Log, tmp_path: Path, levid: Callable[..., Any]) -> None:
    code, out, _ = levid("info", log.path, "--columns")
    assert code == 0
    for text in ("session made", "20.000", "note: 21 °C", "height above the working point"):
        assert text in out
    (found,) = json.loads(levid("info", log.path, "--json").out)["logs"]
    assert (found["rows"], found["begin_s"], found["length_s"]) == (20_000, 2.0, 20.0)
    assert {"name": "gap_m", "unit": "m", "length": 4, "type": "float32"} in found["columns"]
    # A log that is cut off says so, and the command fails.
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(log.path.read_bytes()[:-1_000_000])
    code, out, _ = levid("info", cut)
    assert code == 1
    assert "incomplete" in out
