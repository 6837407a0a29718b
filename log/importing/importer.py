"""Import measured data (CSV, text, NPZ, MAT) into logs that identification can read."""

from __future__ import annotations

import codecs
import hashlib
import itertools
import math
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...config.base import load_yaml
from ...config.files.reading import kind_of
from ..errors import LogError
from ..writer import LogWriter, new_log_file
from .array_variables import load_npz, read_variables
from .clipping import clipping_remarks
from .data_suffixes import FORMAT_OF_SUFFIX
from .delimited_text import TextColumns, read_delimited
from .header_units import unit_slip
from .mat_file_reader import read_mat
from .repaired_readings import repaired
from .signals_yaml import Format, Role, SignalsFile
from .uniform_rows import UniformPart, UniformRows, uniform_rows

Array = NDArray[np.float64]

SCHEMA_NAME = "levid/msg/Signals"
TOPIC = "/levid/signals"
REMARKS = "remarks"
"""Metadata of an imported log: what the import changed, a line for each remark."""
_NEEDED: tuple[Role, ...] = ("input", "output")
_SNIFFED_BYTES = 4096
_FIRST_PRINTABLE = 0x20
_LONGEST_S = 9e9
"""MCAP readers expect times in ns that fit a signed 64-bit integer."""


@dataclass(frozen=True)
class Imported:
    """Logs that an import wrote, with their numbers of rows, and their rate.

    notes: what was changed in the data, or stands out. warnings: likely mistakes in SIGNALS.yaml.
    missing_roles: those of input and output that no column has.
    """

    logs: tuple[tuple[Path, int], ...]
    rate_hz: float
    notes: tuple[str, ...]
    warnings: tuple[str, ...]
    missing_roles: tuple[str, ...]

    @property
    def rows(self) -> int:
        """Number of rows in all logs."""
        return sum(rows for _, rows in self.logs)


def import_file(data_path: Path, signals_path: Path, out_path: Path) -> Imported:
    """Write the log `out_path` from a data file and the SIGNALS.yaml that describes it.

    The log's fields are cycle, time_s (from `begins_s`, by the rate) and the signals, float64,
    scaled to their units. The SIGNALS.yaml becomes the attachment "signals.yaml". Equal files give
    equal logs. Data with long gaps become several logs: LOG-1.mcap, LOG-2.mcap, ...

    Raises:
        ConfigError: the SIGNALS.yaml is invalid.
        LogError: the data do not fit it (file, row, column, what was expected and found), or
            `out_path` exists.
    """
    data_path, signals_path, out_path = Path(data_path), Path(signals_path), Path(out_path)
    signals = load_yaml(signals_path, SignalsFile)
    raw = raw_columns(data_path, signals)
    readings = repaired(str(data_path), signals, raw.values)
    values = [
        _scaled(f"{data_path}: {column.label}", column_values, column.scale, column.offset, signals)
        for column, column_values in zip(signals.columns, readings.values, strict=True)
    ]
    data = uniform_rows(str(data_path), signals, values)
    last = data.parts[-1].place + len(data.parts[-1].values)
    if last / data.rate_hz > _LONGEST_S:
        raise LogError(
            f"{signals_path}: rate_hz: expected {last} samples to last at most "
            f"{_LONGEST_S:g} s, as a log's times do, found {data.rate_hz:g} Hz"
        )
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
    remarks = (*readings.remarks, *data.remarks)
    if remarks:
        metadata[REMARKS] = "\n".join(remarks)
    logs = _write(out_path, signals, signals_path.read_bytes(), data, metadata)
    return Imported(
        tuple(logs),
        data.rate_hz,
        (*raw.notes, *remarks, *_clipping(signals, values), *_identical(signals, values)),
        tuple(_unit_warnings(data_path, signals_path, signals, raw.units)),
        tuple(role for role in _NEEDED if not signals.with_role(role)),
    )


def _write(
    out_path: Path,
    signals: SignalsFile,
    signals_text: bytes,
    data: UniformRows,
    metadata: dict[str, str],
) -> list[tuple[Path, int]]:
    """Write a log for each part and return the paths with the numbers of rows; all or none."""
    paths = [out_path]
    if len(data.parts) > 1:
        digits = len(str(len(data.parts)))
        paths = [
            out_path.with_name(f"{out_path.stem}-{number:0{digits}}{out_path.suffix}")
            for number in range(1, len(data.parts) + 1)
        ]
    with ExitStack() as written:
        # An interrupted import must not leave a log that opens as whole with fewer rows.
        files = [written.enter_context(new_log_file(path)) for path in paths]
        for number, (part, path, file) in enumerate(zip(data.parts, paths, files, strict=True), 1):
            name = f"{metadata['name']}-{number}" if len(paths) > 1 else metadata["name"]
            rows = _rows(signals, part, data.rate_hz)
            with LogWriter(
                path,
                rows.dtype,
                file=file,
                rate_hz=data.rate_hz,
                metadata={**metadata, "name": name},
                attachments={"signals.yaml": signals_text},
                schema_name=SCHEMA_NAME,
                topic=TOPIC,
                units={column.name: column.unit for column in signals.columns},
                chunk_s=math.inf,
            ) as log:
                log.write(rows, np.round(rows["time_s"] * 1e9).astype(np.uint64))
    return [(path, len(part.values)) for path, part in zip(paths, data.parts, strict=True)]


def _scaled(where: str, raw: Array, scale: float, offset: float, signals: SignalsFile) -> Array:
    """Return a column in its unit; raise LogError if a value overflows."""
    with np.errstate(over="ignore"):
        values = scale * raw + offset
    bad = np.flatnonzero(np.isinf(values))
    if bad.size:
        raise LogError(
            f"{where}: row {signals.rows.first + bad[0]}: expected a number that stays finite "
            f"with scale {scale:g}, found {raw[bad[0]]:g}"
        )
    return values


def file_format(path: Path, stated: Format | None = None) -> Format:
    """Return the format of a data file, by its suffix if it is not stated; raise LogError."""
    kind = stated or FORMAT_OF_SUFFIX.get(path.suffix.lower())
    if not path.is_file():
        raise LogError(f"{path}: expected a file, found {kind_of(path)}")
    if kind is None and _is_text(path):
        return "text"
    if kind is None:
        raise LogError(
            f"{path}: expected a text file, or one of {', '.join(FORMAT_OF_SUFFIX)}; for another "
            "suffix set format: csv, text, npz or mat in the signals file; unpack a compressed "
            "file; of a spreadsheet or another binary file, export the data as CSV"
        )
    return kind


def _is_text(path: Path) -> bool:
    """Return whether a file holds text: UTF-16 begins with a mark, others have no zero bytes."""
    with path.open("rb") as file:
        beginning = file.read(_SNIFFED_BYTES)
    marked = beginning.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
    controls = sum(byte < _FIRST_PRINTABLE and byte not in b"\t\n\r\f" for byte in beginning)
    return bool(beginning) and (marked or controls == 0)


def raw_columns(path: Path, signals: SignalsFile) -> TextColumns:
    """Return the columns in the units of the file, all of one length, NaN where a value lacks."""
    kind = file_format(path, signals.format)
    if kind in ("csv", "text"):
        return read_delimited(path, signals, whitespace=kind == "text")
    columns = (
        read_variables(path, signals, load_npz(path)) if kind == "npz" else read_mat(path, signals)
    )
    return TextColumns(columns, [""] * len(columns))


def _rows(signals: SignalsFile, part: UniformPart, rate_hz: float) -> NDArray[np.void]:
    dtype = np.dtype(
        [("cycle", "<u8"), ("time_s", "<f8"), *((column.name, "<f8") for column in signals.columns)]
    )
    rows = np.empty(len(part.values), dtype)
    rows["cycle"] = part.place + np.arange(rows.size)
    rows["time_s"] = signals.begins_s + rows["cycle"] / rate_hz
    for column, value in zip(signals.columns, part.values.T, strict=True):
        rows[column.name] = value
    return rows


def _clipping(signals: SignalsFile, values: list[Array]) -> list[str]:
    return [
        remark
        for column, value in zip(signals.columns, values, strict=True)
        if column.role in ("input", "output")
        for remark in clipping_remarks(
            column.name, column.unit, value, output=column.role == "output"
        )
    ]


def _identical(signals: SignalsFile, values: list[Array]) -> list[str]:
    named = [
        (column.name, value)
        for column, value in zip(signals.columns, values, strict=True)
        if column.role not in ("time", "other")
    ]
    return [
        f"{second} equals {first} in all rows: if both are one channel, delete one of them"
        for (first, a), (second, b) in itertools.combinations(named, 2)
        if np.array_equal(a, b, equal_nan=True)
    ]


def _unit_warnings(
    data_path: Path, signals_path: Path, signals: SignalsFile, units: list[str]
) -> list[str]:
    slips = [
        (column, unit_slip(unit, column.unit, column.scale))
        for column, unit in zip(signals.columns, units, strict=True)
        if unit
    ]
    return [
        f"{signals_path}: {column.name}: {slip} (header of {data_path})"
        for column, slip in slips
        if slip
    ]
