"""Import measured data (CSV, text, NPZ, MAT) into a log that identification can read."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..config.base import load_yaml
from .errors import LogError
from .mat_file_reader import read_mat
from .signals_yaml import Format, SignalsFile
from .tabular_files import load_npz, read_delimited, read_variables
from .writer import LogWriter

SCHEMA_NAME = "levid/msg/Signals"
TOPIC = "/levid/signals"
_LONGEST_S = 9e9
"""MCAP readers expect times in ns that fit a signed 64-bit integer."""

_FORMATS: dict[str, Format] = {
    ".csv": "csv",
    ".txt": "text",
    ".dat": "text",
    ".asc": "text",
    ".npz": "npz",
    ".mat": "mat",
}


def import_file(data_path: Path, signals_path: Path, out_path: Path) -> int:
    """Write the log `out_path` from a data file and the SIGNALS.yaml that describes it.

    The log's fields are cycle, time_s (from 0, by the rate) and the signals, float64, scaled to
    their units. The SIGNALS.yaml becomes the attachment "signals.yaml". Equal files give equal
    logs.

    Returns:
        The number of samples written.

    Raises:
        ConfigError: the SIGNALS.yaml is invalid.
        LogError: the data do not fit it (file, row, column, what was expected and found), or
            `out_path` exists.
    """
    data_path, signals_path = Path(data_path), Path(signals_path)
    signals = load_yaml(signals_path, SignalsFile)
    values = [
        _scaled(f"{data_path}: {column.label}", raw, column.scale, column.offset, signals)
        for column, raw in zip(signals.columns, _raw_columns(data_path, signals), strict=True)
    ]
    if values[0].size / signals.rate_hz > _LONGEST_S:
        raise LogError(
            f"{signals_path}: rate_hz: expected {values[0].size} samples to last at most "
            f"{_LONGEST_S:g} s, as a log's times do, found {signals.rate_hz:g} Hz"
        )
    rows = _rows(signals, values)
    with data_path.open("rb") as source:
        sha256 = hashlib.file_digest(source, "sha256").hexdigest()
    metadata = {
        "kind": "import",
        "name": signals.name or data_path.stem,
        "step": "0",
        "session": "",
        "input_hold": signals.input_hold,
        "source": data_path.name,
        "source_sha256": sha256,
    }
    # An interrupted import must not leave a log that opens as whole with fewer rows.
    part = out_path.with_name(f"{out_path.name}.part")
    with (
        _in_its_place(out_path, part),
        LogWriter(
            part,
            rows.dtype,
            rate_hz=signals.rate_hz,
            metadata=metadata,
            attachments={"signals.yaml": signals_path.read_bytes()},
            schema_name=SCHEMA_NAME,
            topic=TOPIC,
            units={column.name: column.unit for column in signals.columns},
            chunk_s=math.inf,
        ) as log,
    ):
        log.write(rows, np.round(rows["time_s"] * 1e9).astype(np.uint64))
    return rows.size


@contextmanager
def _in_its_place(path: Path, part: Path) -> Iterator[None]:
    """Rename `part` to `path` when it is complete; delete it after an error.

    Raises LogError if `path` exists.
    """
    if path.exists():
        raise LogError(f"{path}: exists; a log is never written over another")
    try:
        part.unlink(missing_ok=True)  # left by an import that was killed
        yield
        try:
            path.hardlink_to(part)  # unlike a rename, it replaces no file
        except FileExistsError:
            raise LogError(f"{path}: exists; a log is never written over another") from None
        except OSError:  # a file system without hard links
            part.rename(path)
    finally:
        part.unlink(missing_ok=True)


def _scaled(
    where: str, raw: NDArray[np.float64], scale: float, offset: float, signals: SignalsFile
) -> NDArray[np.float64]:
    """Return a column in its unit; raise LogError if a value overflows."""
    with np.errstate(over="ignore"):
        values = scale * raw + offset
    bad = np.flatnonzero(~np.isfinite(values))
    if bad.size:
        raise LogError(
            f"{where}: row {signals.rows.first + bad[0]}: expected a number that stays finite "
            f"with scale {scale:g}, found {raw[bad[0]]:g}"
        )
    return values


def _raw_columns(path: Path, signals: SignalsFile) -> list[NDArray[np.float64]]:
    """Return the columns in the units of the file, all of one length, finite."""
    kind = signals.format or _FORMATS.get(path.suffix.lower())
    if kind is None:
        raise LogError(
            f"{path}: expected one of {', '.join(_FORMATS)}; "
            "for another suffix set format: csv, text, npz or mat in the signals file"
        )
    if not path.is_file():
        raise LogError(f"{path}: expected a file, found {'a folder' if path.exists() else 'none'}")
    if kind == "npz":
        return read_variables(path, signals, load_npz(path))
    if kind == "mat":
        return read_mat(path, signals)
    return read_delimited(path, signals, whitespace=kind == "text")


def _rows(signals: SignalsFile, values: list[NDArray[np.float64]]) -> NDArray[np.void]:
    dtype = np.dtype(
        [("cycle", "<u8"), ("time_s", "<f8"), *((column.name, "<f8") for column in signals.columns)]
    )
    rows = np.empty(values[0].size, dtype)
    rows["cycle"] = np.arange(rows.size)
    rows["time_s"] = np.arange(rows.size) / signals.rate_hz
    for column, value in zip(signals.columns, values, strict=True):
        rows[column.name] = value
    return rows
