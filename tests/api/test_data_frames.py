"""Test the tables: pandas, xarray and Arrow hold the log's values with units."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import levid


def test_pandas_has_a_row_per_cycle_and_units(session: levid.Session) -> None:
    pytest.importorskip("pandas", reason="levid[data] is not installed")
    frame = session.to_pandas()
    assert len(frame) == sum(map(len, session))
    assert frame.index.name == "time_s"
    assert list(frame.columns) == ["record", *session.columns]
    assert list(frame["record"].cat.categories) == ["psi", "theta", "z"]
    assert frame.attrs["units"]["time_s"] == "s"
    assert frame.attrs["units"]["v_psi_n_m"] == "N m"
    z = frame[frame["record"] == "z"]
    np.testing.assert_array_equal(z["gap_m_8"], session["z"]["gap_m"][:, 8])
    np.testing.assert_array_equal(z.index, session["z"].time_s)
    # Time is that of the session: it runs on from record to record.
    assert frame.index.is_monotonic_increasing
    assert frame.index.is_unique
    assert frame["z_m"].dtype == np.float32  # as logged


def test_columns_select_signals_and_single_values(session: levid.Session) -> None:
    pytest.importorskip("pandas", reason="levid[data] is not installed")
    frame = session.to_pandas(["z_m", "coil_n_2"])
    assert list(frame.columns) == ["record", "z_m", "coil_n_2"]
    assert list(session["psi"].to_pandas("gap_m").columns) == [f"gap_m_{k}" for k in range(9)]
    with pytest.raises(levid.LogError, match=r"found 'z_mm'; there is z_m"):
        session.to_pandas(["z_mm"])


def test_xarray_has_dimensions_coil_and_sensor_and_units(session: levid.Session) -> None:
    pytest.importorskip("xarray", reason="levid[data] is not installed")
    data = session.to_xarray()
    assert data.gap_m.dims == ("time", "sensor")
    assert data.coil_n.dims == ("time", "coil")
    assert data.sizes["sensor"] == data.sizes["coil"] == 9
    assert data.gap_m.attrs["units"] == "m"
    assert data.time.attrs["units"] == "s"
    assert data.attrs["rate_hz"] == 500.0
    z = data.where(data.record == "z", drop=True)
    np.testing.assert_array_equal(z.gap_m, session["z"]["gap_m"])


def test_arrow_has_the_columns_of_pandas_and_units(session: levid.Session, tmp_path: Path) -> None:
    pytest.importorskip("pyarrow", reason="levid[data] is not installed")
    import pyarrow.parquet as pq

    table = session.to_arrow(["z_m", "gap_m"])
    assert table.column_names == ["record", "time_s", "z_m", *(f"gap_m_{k}" for k in range(9))]
    assert table.schema.field("gap_m_0").metadata == {b"unit": b"m"}
    pq.write_table(table, tmp_path / "short.parquet")
    again = pq.read_table(tmp_path / "short.parquet")
    assert again.schema.field("z_m").metadata[b"unit"] == b"m"
    assert again.column("record").to_pylist()[-1] == "z"
    assert session[0].to_arrow(["z_m"]).column_names == ["time_s", "z_m"]


def test_logs_with_different_signals_are_of_two_plants(
    flown: Path, imported: levid.Session
) -> None:
    with pytest.raises(levid.LogError, match="expected logs of one plant"):
        levid.load([flown, *imported.logs])


@pytest.mark.parametrize(
    ("package", "table"),
    [
        ("pandas", levid.Session.to_pandas),
        ("xarray", levid.Session.to_xarray),
        ("pyarrow", levid.Session.to_arrow),
    ],
)
def test_missing_package_says_how_to_install_it(
    session: levid.Session,
    monkeypatch: pytest.MonkeyPatch,
    package: str,
    table: Callable[[levid.Session], object],
) -> None:
    monkeypatch.setitem(sys.modules, package, None)  # as if it were not installed
    with pytest.raises(ImportError, match=r"pip install 'levid\[data\]'"):
        table(session)
