"""Write a catalogue as a Parquet table."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import datetime
from pathlib import Path

from ...config.files.atomic_write import atomic_file
from ..exporting.parquet_file import pyarrow_module
from .catalogue import Run, plain_run


def write_catalogue_parquet(path: Path, runs: Sequence[Run]) -> None:
    """Write one row a flight; `flown` is a time in UTC, `results` a list of structs.

    Raises:
        LogError: pyarrow is not installed.
    """
    pa = pyarrow_module("pyarrow")
    parquet = pyarrow_module("pyarrow.parquet")
    text, whole, number = pa.string(), pa.int64(), pa.float64()
    result = pa.struct(
        [
            ("path", text),
            ("command", text),
            ("logs", pa.list_(text)),
            ("written", text),
            ("outcome", text),
        ]
    )
    schema = pa.schema(
        [
            ("folder", text),
            ("flown", pa.timestamp("s", "UTC")),
            ("virtual", pa.bool_()),
            *((name, text) for name in ("rig", "session", "note")),
            ("rate_hz", number),
            *((name, whole) for name in ("logs", "records", "rows")),
            ("length_s", number),
            *((name, whole) for name in ("fault", "incomplete", "unreadable", "bytes")),
            *((name, text) for name in ("levid", "identify", "trace")),
            ("results", pa.list_(result)),
        ]
    )
    rows = []
    for run in runs:
        plain = plain_run(run)
        plain["flown"] = datetime.fromisoformat(run.summary.flown)
        rows.append({name: plain[name] for name in schema.names})
    with atomic_file(path) as file:
        parquet.write_table(pa.Table.from_pylist(rows, schema=schema), file)
