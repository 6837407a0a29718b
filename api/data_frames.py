"""Convert records to pandas, xarray and Arrow, with units."""

from __future__ import annotations

import importlib
from collections.abc import Iterable, Sequence
from types import ModuleType
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..log.errors import LogError
from ..log.signals import SIGNALS
from .signal_table import SignalTable, listed

if TYPE_CHECKING:
    import pandas as pd
    import pyarrow as pa
    import xarray as xr

    from .record import Record

_DIMENSIONS = {s.name: s.shape for s in SIGNALS if s.shape != "scalar"}


def to_pandas(records: Sequence[Record], columns: Iterable[str] | None) -> pd.DataFrame:
    """Return the rows of all records with the column `record` and the index time_s in s."""
    pandas = _package("pandas")
    columns = listed(columns)
    selected = _same_signals(records, columns)
    names = [r.name for r in records]
    codes = np.repeat(np.arange(len(records)), [len(r.time_s) for r in records])
    data: dict[str, Any] = {"record": pandas.Categorical.from_codes(codes, names)}
    for column in _column_names(selected):
        data[column] = np.concatenate([r[column] for r in records])
    time_s = np.concatenate([r.time_s for r in records])
    return _frame(pandas, data, time_s, selected)


def record_to_pandas(record: Record, columns: Iterable[str] | None) -> pd.DataFrame:
    """Return the rows of one record with the index time_s in s."""
    pandas = _package("pandas")
    selected = record.selected(listed(columns))
    data = {column: record[column] for column in _column_names(selected)}
    return _frame(pandas, data, record.time_s, selected)


def to_xarray(records: Sequence[Record], columns: Iterable[str] | None) -> xr.Dataset:
    """Return the records along the dimension time; signals of coils and sensors have their own."""
    xarray = _package("xarray")
    selected = _same_signals(records, listed(columns))
    variables: dict[str, Any] = {}
    coordinates: dict[str, Any] = {
        "time": (
            "time",
            np.concatenate([r.time_s for r in records]),
            {"units": "s", "long_name": "time"},
        ),
        "record": ("time", np.repeat([r.name for r in records], [len(r.time_s) for r in records])),
    }
    for signal in selected:
        values = np.concatenate([r[signal.name] for r in records])
        dimensions = ["time"]
        if signal.length is not None:
            dimension = _DIMENSIONS.get(signal.name, f"{signal.name}_number")
            dimensions.append(dimension)
            coordinates[dimension] = np.arange(signal.length)
        about = {"units": signal.unit, "long_name": signal.meaning, "role": signal.role}
        variables[signal.name] = (dimensions, values, {k: v for k, v in about.items() if v})
    rates = {r.rate_hz for r in records}
    attributes = {"rate_hz": rates.pop()} if len(rates) == 1 else {}
    dataset: xr.Dataset = xarray.Dataset(variables, coordinates, attributes)
    return dataset


def to_arrow(
    records: Sequence[Record], columns: Iterable[str] | None, *, with_record: bool = True
) -> pa.Table:
    """Return the columns of to_pandas as an Arrow table; a field's metadata has its unit."""
    arrow = _package("pyarrow")
    selected = _same_signals(records, listed(columns))
    fields, arrays = [], []
    if with_record:
        codes = np.repeat(np.arange(len(records), dtype=np.int32), [len(r.time_s) for r in records])
        arrays.append(arrow.DictionaryArray.from_arrays(codes, [r.name for r in records]))
        fields.append(arrow.field("record", arrays[0].type))
    units = {"time_s": "s", **_units(selected)}
    for column, unit in units.items():
        parts = [r.time_s if column == "time_s" else r[column] for r in records]
        arrays.append(arrow.array(np.concatenate(parts)))
        fields.append(arrow.field(column, arrays[-1].type, metadata={"unit": unit}))
    return arrow.table(arrays, schema=arrow.schema(fields))


def _frame(
    pandas: ModuleType, data: dict[str, Any], time_s: NDArray[np.float64], selected: SignalTable
) -> pd.DataFrame:
    frame = pandas.DataFrame(data, index=pandas.Index(time_s, name="time_s"))
    frame.attrs["units"] = {"time_s": "s", **_units(selected)}
    return frame


def _same_signals(records: Sequence[Record], columns: Sequence[str] | None) -> SignalTable:
    """Return the selected signals, which all records must have."""
    first = records[0].selected(columns)
    for record in records[1:]:
        other = record.selected(columns)
        names, others = ({s.name: s.length for s in t} for t in (first, other))
        if names != others:
            apart = sorted(set(names.items()) ^ set(others.items()), key=str)
            raise LogError(
                f"expected records with the same signals, found differences between "
                f"{records[0].name} and {record.name}: {', '.join(n for n, _ in apart[:3])}; "
                "select common columns, or take the table of one record"
            )
    return first


def _column_names(selected: SignalTable) -> list[str]:
    return [column for signal in selected for column in signal.columns]


def _units(selected: SignalTable) -> dict[str, str]:
    return {column: signal.unit for signal in selected for column in signal.columns}


def _package(name: str) -> ModuleType:
    try:
        return importlib.import_module(name)
    except ModuleNotFoundError as error:
        if error.name != name:
            raise
        raise ImportError(
            f"expected the package {name}, found none; run: pip install 'levid[data]'", name=name
        ) from None
