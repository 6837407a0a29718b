"""Write Parquet files with units in the metadata of each column."""

from __future__ import annotations

import importlib
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from types import ModuleType
from typing import BinaryIO

import numpy as np

from ..errors import LogError
from ..log_stream import Block
from .columns import Column

_ROW_GROUP = 1 << 15
"""Rows of a row group: a reader skips groups outside of the time that it asks for."""


def write_parquet(
    path: Path,  # noqa: ARG001 - of messages in other formats
    file: BinaryIO,
    columns: Sequence[Column],
    blocks: Iterable[Block],
    facts: Mapping[str, str],
) -> int:
    """Write a Parquet file (zstd); return the number of rows.

    Array fields become one column an element. The metadata of a column has `unit` and `meaning`,
    those of the file has `facts`.

    Raises:
        LogError: pyarrow is not installed.
    """
    pa = pyarrow_module("pyarrow")
    parquet = pyarrow_module("pyarrow.parquet")
    fields = [
        pa.field(name, pa.from_numpy_dtype(c.dtype), False, {"unit": c.unit, "meaning": c.meaning})
        for c in columns
        for name in c.flat_names
    ]
    schema = pa.schema(fields, dict(facts))
    rows = 0
    with parquet.ParquetWriter(file, schema, compression="zstd") as writer:
        for group in _grouped(blocks):
            arrays = []
            for column in columns:
                parts = zip(*map(column.flat_values, group), strict=True)
                arrays += [pa.array(np.concatenate(part)) for part in parts]
            table = pa.Table.from_arrays(arrays, schema=schema)
            writer.write_table(table, row_group_size=len(table))
            rows += len(table)
    return rows


def _grouped(blocks: Iterable[Block]) -> Iterable[list[Block]]:
    group: list[Block] = []
    for block in blocks:
        group.append(block)
        if sum(len(b.rows) for b in group) >= _ROW_GROUP:
            yield group
            group = []
    if group:
        yield group


def pyarrow_module(name: str) -> ModuleType:
    """Return a module of pyarrow; raise LogError with the command that installs it."""
    try:
        return importlib.import_module(name)
    except ModuleNotFoundError as error:
        if (error.name or "").partition(".")[0] != "pyarrow":
            raise
        raise LogError(
            "Parquet files need the package pyarrow, which is not installed: "
            "pip install 'levid[data]'"
        ) from None
