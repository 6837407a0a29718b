"""Export one log as a table: CSV, Parquet, MAT or NPZ."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO, Literal, get_args

import numpy as np

from ...config.files.atomic_write import atomic_file, write_file
from ...config.version import __version__
from ..errors import LogError, reason
from ..log_facts import rig_name
from ..log_stream import Block, LogStream
from .columns import TIME, Column, chosen_columns
from .csv_file import write_csv
from .decimation import MOST, PASS, decimated
from .import_description import description_path, import_description
from .mat_file import write_mat
from .npz_file import write_npz
from .parquet_file import write_parquet

Format = Literal["csv", "parquet", "mat", "npz"]
FORMATS: tuple[Format, ...] = get_args(Format)

_Writer = Callable[
    [Path, BinaryIO, Sequence[Column], Iterable[Block], Mapping[str, str]],
    int,
]
_WRITERS: dict[Format, _Writer] = {
    "csv": write_csv,
    "parquet": write_parquet,
    "mat": write_mat,
    "npz": write_npz,
}


@dataclass(frozen=True)
class ExportOptions:
    """Choose what is exported.

    columns: fields, elements or groups, empty for all. begin_s, end_s: range of the log's time, as
    in `time_s`. every: keep every N-th row of low-pass filtered signals. overwrite: replace
    existing files.
    """

    columns: tuple[str, ...] = ()
    begin_s: float | None = None
    end_s: float | None = None
    every: int = 1
    overwrite: bool = False


@dataclass(frozen=True)
class Exported:
    """An exported file: rows and columns in it, the description beside a CSV file, remarks."""

    path: Path
    rows: int
    columns: tuple[Column, ...]
    description: Path | None
    notes: tuple[str, ...]


def format_of(path: Path) -> Format:
    """Return the format that a file's suffix names; raise LogError for another suffix."""
    kind = path.suffix.lower().removeprefix(".")
    if kind not in FORMATS:
        raise LogError(
            f"{path}: expected a file name that ends with .csv, .parquet, .mat or .npz, found "
            f"'{path.suffix or path.name}'; for a folder give --format"
        )
    return kind


def export_log(
    log_path: Path | str,
    out: Path | str,
    options: ExportOptions | None = None,
    kind: Format | None = None,
) -> Exported:
    """Write the rows of a log to the file `out`, in memory that does not grow with the log.

    kind: format; default: by the suffix of `out`. The file appears when it is complete.

    Raises:
        LogError: the log cannot be read, a column or the range of time does not exist, `out`
            exists, or a package is missing.
    """
    options, out = options or ExportOptions(), Path(out)
    kind = kind or format_of(out)
    if not 1 <= options.every <= MOST:
        raise LogError(f"every: expected 1 to {MOST}, found {options.every}")
    described = description_path(out) if kind == "csv" else None
    for path in filter(None, (out, described)):
        if (path.exists() or path.is_symlink()) and not options.overwrite:
            raise _exists(path)
    log = LogStream(log_path)
    columns = chosen_columns(log, options.columns)
    facts = _facts(log, options)
    counted = _Counted(rows_in_range(log, options.begin_s, options.end_s), options.every)
    try:
        with atomic_file(out, replace=options.overwrite) as file:
            rows = _WRITERS[kind](out, file, columns, counted.blocks(), facts)
            if described is not None:
                text = import_description(log, columns, facts, counted.begin_s)
                write_file(described, text, replace=options.overwrite)
    except FileExistsError as error:
        raise _exists(error.filename) from None
    except OSError as error:
        raise LogError(f"{out}: cannot be written: {reason(error)}") from None
    return Exported(out, rows, columns, described, tuple(_notes(log, options, counted.skipped)))


def _exists(path: Path | str) -> LogError:
    return LogError(f"{path}: exists; give another name, or --overwrite")


class _Counted:
    """Count skipped periods, and remember the time of the first row, while blocks pass."""

    def __init__(self, blocks: Iterator[Block], every: int) -> None:
        self._blocks, self._every = blocks, every
        self.skipped, self.begin_s = 0, 0.0

    def blocks(self) -> Iterator[Block]:
        return decimated(self._seen(), self._every)

    def _seen(self) -> Iterator[Block]:
        first = True
        for block in self._blocks:
            names = block.rows.dtype.names or ()
            if first and TIME in names:
                self.begin_s = max(float(block.rows[TIME][0]), 0.0)
            if "skipped" in names:
                self.skipped += int(block.rows["skipped"][first:].sum(dtype=np.int64))
            first = False
            yield block


def rows_in_range(
    log: LogStream, begin_s: float | None = None, end_s: float | None = None
) -> Iterator[Block]:
    """Yield the rows whose time is in a range, its ends included; None is no limit.

    Raises:
        LogError: there are none.
    """
    begin = -np.inf if begin_s is None else begin_s
    end = np.inf if end_s is None else end_s
    whole = begin_s is None and end_s is None
    low, high, found = np.inf, -np.inf, False
    for block in log.blocks():
        if whole:
            yield block
            continue
        t = time_of(log, block)
        low, high = min(low, float(t[0])), max(high, float(t[-1]))
        inside = (t >= begin) & (t <= end)
        if inside.any():
            found = True
            yield Block(block.rows[inside], block.log_time_ns[inside])
        if t[0] > end:
            break
    if not whole and not found:
        raise LogError(
            f"{log.path}: expected a part of {low:g} to {high:g} s, the times of this log, found "
            f"{begin:g} to {end:g} s"
        )


def time_of(log: LogStream, block: Block) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    """Return the time of each row in s: `time_s`, else the log time."""
    if TIME in log.names:
        return np.asarray(block.rows[TIME], np.float64)
    return np.asarray(block.log_time_ns / 1e9, np.float64)


def _facts(log: LogStream, options: ExportOptions) -> dict[str, str]:
    facts = {"source": log.path.name, "rig": rig_name(log.attachments), **log.metadata}
    facts["rate_hz"] = repr(log.rate_hz / options.every)
    if options.every > 1:
        facts["every"] = f"{options.every} rows, low-pass filtered"
    facts["exported_by"] = f"levid {__version__}"
    return {key: value for key, value in facts.items() if value}


def _notes(log: LogStream, options: ExportOptions, skipped: int) -> Iterator[str]:
    if log.problem is not None:
        yield f"{log.path}: incomplete: {log.problem}"
    if options.every > 1:
        nyquist_hz = log.rate_hz / options.every / 2
        yield (
            f"every {options.every} rows: signals are low-pass filtered, unchanged up to "
            f"{PASS * nyquist_hz:.4g} Hz and removed above {nyquist_hz:.4g} Hz"
        )
        if skipped:
            yield f"{log.path}: {skipped} skipped periods: the filter treats its rows as uniform"
