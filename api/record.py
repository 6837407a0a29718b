"""One log in memory: its signals as arrays and tables."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..config.escaping import html_text
from ..log.errors import LogError
from ..log.mcap_scan import scan
from ..log.reader import Log, described_channel, mapped, rate_hz_of, read_log
from .html_table import Table
from .read_only_arrays import read_only
from .signal_table import SignalInfo, SignalTable, listed, signals_of

if TYPE_CHECKING:
    import pandas as pd
    import pyarrow as pa
    import xarray as xr
    from matplotlib.figure import Figure

_UNTIMED = np.zeros(0, np.uint64)


@dataclass(frozen=True)
class _Head:
    """Facts of a log that are known without its rows; rows, rate_hz: None if they are not."""

    metadata: Mapping[str, str]
    attachments: Mapping[str, bytes]
    signals: SignalTable
    rows: int | None
    rate_hz: float | None


class Record:
    """One log: `record["z_m"]` is a signal as an array, `record.to_pandas()` all of them.

    Opening it reads names, units and metadata. The rows are read when they are first needed.

    Raises:
        LogError: no such file, or it is not a log.
    """

    def __init__(self, path: str | Path, name: str | None = None, keep: object = None) -> None:
        """Open the log at `path`; `keep` is kept as long as the record, such as its folder."""
        self.path = Path(path)
        self._head = _read_head(self.path)
        self._keep = keep
        self.name = name or self._head.metadata.get("name") or self.path.stem
        """Name of the record, unique within its session."""

    @property
    def kind(self) -> str:
        """Step of the session: record, levitate, move or land; import for imported data."""
        return self._head.metadata.get("kind", "record")

    @property
    def session_name(self) -> str:
        """Name of the session that the log belongs to, else the log's own."""
        return self._head.metadata.get("session") or self.path.stem

    @property
    def metadata(self) -> dict[str, str]:
        """Pairs of text that the log states."""
        return dict(self._head.metadata)

    @property
    def attachments(self) -> dict[str, bytes]:
        """Files in the log by name, such as rig.yaml, session.yaml or signals.yaml."""
        return dict(self._head.attachments)

    @property
    def signals(self) -> SignalTable:
        """Name, unit, role and meaning of each signal."""
        return self._head.signals

    @property
    def columns(self) -> tuple[str, ...]:
        """Columns of the data frame: gap_m with nine values becomes gap_m_0 to gap_m_8."""
        return tuple(c for s in self.signals if s.name != "time_s" for c in s.columns)

    @property
    def rate_hz(self) -> float:
        """Sampling rate in Hz."""
        return self.log.rate_hz if self._head.rate_hz is None else self._head.rate_hz

    @property
    def duration_s(self) -> float:
        """Number of rows over the rate, in s."""
        return len(self) / self.rate_hz

    @property
    def problem(self) -> str | None:
        """Where and why a cut off or damaged log ends early; None for a whole log."""
        return self.log.problem

    @cached_property
    def log(self) -> Log:
        """The log as read; not a part of the stable API."""
        log = read_log(self.path)
        return replace(log, rows=read_only(log.rows), log_time_ns=read_only(log.log_time_ns))

    @cached_property
    def time_s(self) -> NDArray[np.float64]:
        """Time of each row in s (n,): of the session, else since the log's first row; read-only."""
        if "time_s" in (self.log.rows.dtype.names or ()):
            return read_only(np.asarray(self.log.rows["time_s"], np.float64))
        time_ns = self.log.log_time_ns
        return read_only(1e-9 * (time_ns - time_ns[0]).astype(np.float64))

    def __len__(self) -> int:
        return len(self.log.rows) if self._head.rows is None else self._head.rows

    def __getitem__(self, name: str) -> NDArray[Any]:
        """Return a signal (n,) or (n, length), or one column of it such as gap_m_3 (n,); read-only.

        Raises:
            LogError: the log has no such signal or column.
        """
        for signal in self.signals:
            if name == signal.name:
                return read_only(np.ascontiguousarray(self.log.rows[name]))
            if name in signal.columns:
                column = self.log.rows[signal.name][:, signal.columns.index(name)]
                return read_only(np.ascontiguousarray(column))
        raise self._unknown(name)

    def selected(self, columns: Iterable[str] | None) -> SignalTable:
        """Return the signals of some columns, each as a signal of its own if it is only a part.

        Raises:
            LogError: the log has no such signal or column.
        """
        names = listed(columns)
        if names is None:
            return SignalTable([s for s in self.signals if s.name != "time_s"])
        found = []
        for name in names:
            whole = [s for s in self.signals if s.name == name]
            part = [s for s in self.signals if name in s.columns]
            if not whole and not part:
                raise self._unknown(name)
            found += whole or [SignalInfo(name, s.unit, s.role, s.meaning) for s in part]
        return SignalTable(found)

    def to_pandas(self, columns: Iterable[str] | None = None) -> pd.DataFrame:
        """Return a data frame: a row per cycle, index time_s in s, units in attrs["units"].

        `columns`: signals or columns; default: all. A signal with several values has a column for
        each. Raises ImportError without pandas, LogError for an unknown column.
        """
        from .data_frames import record_to_pandas

        return record_to_pandas(self, columns)

    def to_xarray(self, columns: Iterable[str] | None = None) -> xr.Dataset:
        """Return a dataset with the dimensions time, coil and sensor, and units as attributes.

        Raises ImportError without xarray, LogError for an unknown signal.
        """
        from .data_frames import to_xarray

        return to_xarray([self], columns)

    def to_arrow(self, columns: Iterable[str] | None = None) -> pa.Table:
        """Return an Arrow table with the columns of to_pandas, time_s first, units as metadata.

        Raises ImportError without pyarrow, LogError for an unknown column.
        """
        from .data_frames import to_arrow

        return to_arrow([self], columns, with_record=False)

    def export(self, path: str | Path, columns: Iterable[str] | None = None) -> Path:
        """Write the rows to a .csv, .parquet, .mat or .npz file with units; return its path.

        The memory does not grow with the log.

        Raises:
            LogError: a column does not exist, the file exists, or a package is missing.
        """
        from ..log.exporting.export_log import ExportOptions, export_log

        export_log(self.path, path, ExportOptions(columns=tuple(listed(columns) or ())))
        return Path(path)

    def plot(self, columns: Iterable[str] | None = None) -> Figure:
        """Draw signals over time; default: inputs, outputs and excitation."""
        from .signal_plot import signal_plot

        return signal_plot([self], columns)

    def __repr__(self) -> str:
        return (
            f"<Record {self.name}: {self.duration_s:.6g} s at {self.rate_hz:.6g} Hz, "
            f"{len(self.columns)} columns, {self.path}>"
        )

    def _repr_html_(self) -> str:
        length = f"{self.duration_s:.6g} s at {self.rate_hz:.6g} Hz"
        head = f"<p><b>Record {html_text(self.name)}</b>: {length}</p>"
        return head + self.signals._repr_html_()

    def _unknown(self, name: str) -> LogError:
        known = [*(s.name for s in self.signals), *self.columns]
        close = difflib.get_close_matches(name, known, n=3) or [s.name for s in self.signals]
        return LogError(
            f"record {self.name}: expected a signal or column of the log, found '{name}'; there "
            f"is {', '.join(close)}"
        )

    def __reduce__(self) -> tuple[type[Record], tuple[Path, str]]:
        return Record, (self.path, self.name)


def record_table(records: Iterable[Record]) -> Table:
    """Return name, kind, length and rate of records."""
    rows = [
        (r.name, r.kind, f"{r.duration_s:.6g} s", f"{r.rate_hz:.6g} Hz", r.path.name)
        for r in records
    ]
    return Table(("record", "kind", "length", "rate", "log"), rows)


def _read_head(path: Path) -> _Head:
    try:
        contents = scan(mapped(path))
        channel, dtype = described_channel(contents)
        metadata = contents.facts
        rate_hz = rate_hz_of(metadata, _UNTIMED) if "rate_hz" in metadata else None
    except LogError as error:
        raise LogError(f"{path}: {error}") from None
    schema = contents.schemas[contents.channels[channel].schema_id]
    lengths = {
        name: (dtype[name].shape[0] if dtype[name].shape else None) for name in dtype.names or ()
    }
    text = str(schema.data, "utf-8", "replace")
    # A log that was cut off has no counts, or more of them than rows.
    whole = contents.problem is None and contents.message_counts is not None
    rows = (contents.message_counts or {}).get(channel) if whole else None
    return _Head(
        metadata,
        contents.attachments,
        SignalTable(signals_of(text, lengths, contents.attachments)),
        rows,
        rate_hz,
    )
