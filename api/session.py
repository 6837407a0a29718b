"""Load logs as a session: records, tables, identification, trace, plots."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from ..config.escaping import html_text
from ..config.files.folders import make_folder
from ..log.errors import LogError
from ..log.importing.data_suffixes import FORMAT_OF_SUFFIX
from .record import Record, record_table
from .signal_table import SignalTable, listed

if TYPE_CHECKING:
    import pandas as pd
    import pyarrow as pa
    import xarray as xr
    from matplotlib.figure import Figure

    from .identification import Identification
    from .model import ModelSource
    from .trace import Trace

Progress = Callable[[str, float], None]
"""Called with the current activity and the completed fraction, 0 to 1."""
Warn = Callable[[str], None]
"""Called with a warning in words; the default is warnings.warn."""
_SAMPLES = ("record", "import")


@dataclass(frozen=True)
class RigInfo:
    """The rig that flew a session: name, positions of its coils and sensors in m, RIG.yaml."""

    name: str
    coil_xy_m: tuple[tuple[float, float], ...]
    sensor_xy_m: tuple[tuple[float, float], ...]
    yaml: str


def load(
    path_or_paths: str | Path | Iterable[str | Path],
    model: ModelSource | None = None,
    *,
    signals: str | Path | None = None,
) -> Session:
    """Load a log, a folder of logs, or a list of logs and folders; or data files with `signals`.

    Names, units and lengths are read at once, rows when they are first needed.

    Args:
        path_or_paths: logs (.mcap), or folders of logs; with `signals` files of measured data (CSV,
            text, NPZ, MAT), which are imported into a temporary folder.
        model: default of `Session.identify` and `Session.trace`: a MODEL.yaml, or a result.
        signals: SIGNALS.yaml that describes the columns of data files, or a shipped one's name.

    Raises:
        LogError: no such file, no logs in a folder, a file that is not a log, data that do not fit
            `signals`, or logs of two rigs.
        ConfigError: `signals` is not valid.
    """
    if isinstance(path_or_paths, str | Path):
        path_or_paths = [path_or_paths]
    given = [Path(path) for path in path_or_paths]
    if not given:
        raise LogError("expected at least one log, found an empty list")
    if signals is not None:
        from ..config.shipped import find_file
        from .data_import import imported_logs

        logs, keep = imported_logs(given, find_file(signals, "signals"))
        session = Session(logs, model, keep)
    else:
        session = Session([log for path in given for log in _logs_of(path)], model)
    session.require_one_plant()  # reports a bad file here
    return session


class Session:
    """Logs that belong together: a flown session, several sessions, or imported data.

    Iteration, len, `names` and the tables cover the records. `steps` has all logs, such as those of
    lift-off and landing.
    """

    def __init__(
        self, logs: Sequence[Path], model: ModelSource | None = None, keep: object = None
    ) -> None:
        """Hold `logs`; `keep` is kept as long as the session, such as a temporary folder."""
        self.logs = tuple(logs)
        """Paths of all logs."""
        self.model = model
        """Default model of identify and trace; None: that of the rig in the logs."""
        self._keep = keep

    @cached_property
    def steps(self) -> tuple[Record, ...]:
        """All logs in order, also those of lift-off, moves and landing."""
        records = [Record(path, keep=self._keep) for path in self.logs]
        for longer in (_with_folder, _with_path):
            often = {name for name, n in Counter(r.name for r in records).items() if n > 1}
            for record in records:
                if record.name in often:
                    record.name = longer(record)
        return tuple(records)

    def require_one_plant(self) -> None:
        """Check that the logs are of one rig, or all of imported data.

        Raises:
            LogError: they are of two rigs, or of a rig and of imported data.
        """
        from ..identification.records.one_plant import require_one_plant

        require_one_plant(self.steps)

    @cached_property
    def records(self) -> tuple[Record, ...]:
        """The records, without lift-off, moves and landing.

        Raises:
            LogError: there is no record among the logs.
        """
        found = tuple(r for r in self.steps if r.kind in _SAMPLES)
        if not found:
            kinds = ", ".join(dict.fromkeys(r.kind for r in self.steps))
            raise LogError(
                f"{self.logs[0].parent}: expected logs of records, found only {kinds}; "
                "session.steps has these"
            )
        return found

    @property
    def name(self) -> str:
        """Name of the flown session, or of the imported data."""
        names = dict.fromkeys(r.session_name for r in self.steps)
        return ", ".join(names)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the records."""
        return tuple(r.name for r in self.records)

    @property
    def rig(self) -> RigInfo | None:
        """The rig that flew the first log; None for imported data.

        Raises:
            ConfigError: the RIG.yaml in the log is not valid.
        """
        from ..config.base import parse_text
        from ..config.rig import RigConfig

        text = self.steps[0].attachments.get("rig.yaml")
        if text is None:
            return None
        rig = parse_text(text, RigConfig, f"{self.logs[0]}: rig.yaml")
        g = rig.geometry
        return RigInfo(
            rig.name,
            tuple(zip(g.coil_x_m, g.coil_y_m, strict=True)),
            tuple(zip(g.sensors_x_m, g.sensors_y_m, strict=True)),
            text.decode(errors="replace"),
        )

    @property
    def signals(self) -> SignalTable:
        """Name, unit, role and meaning of each signal in the records."""
        return SignalTable(list({s.name: s for r in self.records for s in r.signals}.values()))

    @property
    def columns(self) -> tuple[str, ...]:
        """Columns of the data frame, without index and record."""
        return tuple(dict.fromkeys(c for r in self.records for c in r.columns))

    @property
    def rate_hz(self) -> float:
        """Sampling rate in Hz.

        Raises:
            LogError: the records have different rates; each record has its own.
        """
        rates: dict[float, str] = {}
        for record in self.records:
            rates.setdefault(record.rate_hz, record.name)
        if len(rates) > 1:
            found = ", ".join(f"{rate:.6g} Hz in {name}" for rate, name in rates.items())
            raise LogError(f"expected records of one rate, found {found}; use record.rate_hz")
        return self.records[0].rate_hz

    @property
    def duration_s(self) -> float:
        """Length of all records together, in s."""
        return sum(r.duration_s for r in self.records)

    def record(self, name_or_number: str | int) -> Record:
        """Return a record by name or number from 0; other steps by name only.

        Raises:
            LogError: there is none of this name or number.
        """
        if isinstance(name_or_number, int):
            if not -len(self.records) <= name_or_number < len(self.records):
                raise LogError(
                    f"expected a record number from 0 to {len(self.records) - 1}, found "
                    f"{name_or_number}"
                )
            return self.records[name_or_number]
        for record in self.steps:
            if record.name == name_or_number:
                return record
        names = ", ".join(r.name for r in self.steps)
        raise LogError(f"expected one of the records {names}; found '{name_or_number}'")

    def __getitem__(self, name_or_number: str | int) -> Record:
        return self.record(name_or_number)

    def __iter__(self) -> Iterator[Record]:
        return iter(self.records)

    def __len__(self) -> int:
        return len(self.records)

    def to_pandas(self, columns: Iterable[str] | None = None) -> pd.DataFrame:
        """Return a data frame: a row per cycle of all records, index time_s, first column record.

        The index is the time of the session in s, a float as in the log: virtual flights and
        imported data have no date. `columns`: signals or columns of them; default: all. A signal
        with several values has a column for each (gap_m_0, gap_m_1, ...). attrs["units"] has the
        unit of each column.

        Raises:
            ImportError: pandas is not installed.
            LogError: a record has no such column, or the records have different columns.
        """
        from .data_frames import to_pandas

        return to_pandas(self.records, columns)

    def to_xarray(self, columns: Iterable[str] | None = None) -> xr.Dataset:
        """Return a dataset with the dimensions time, coil and sensor, and units as attributes.

        `record` is a coordinate along time. `columns`: names of signals; default: all.

        Raises:
            ImportError: xarray is not installed.
            LogError: a record has no such signal, or the records have different signals.
        """
        from .data_frames import to_xarray

        return to_xarray(self.records, columns)

    def to_arrow(self, columns: Iterable[str] | None = None) -> pa.Table:
        """Return an Arrow table: record, time_s, and the columns of to_pandas.

        Each field has its unit in its metadata. Polars, DuckDB and Parquet read such a table
        without a copy.

        Raises:
            ImportError: pyarrow is not installed.
            LogError: a record has no such column, or the records have different columns.
        """
        from .data_frames import to_arrow

        return to_arrow(self.records, columns)

    def export(
        self,
        folder: str | Path,
        kind: Literal["csv", "parquet", "mat", "npz"] = "parquet",
        columns: Iterable[str] | None = None,
    ) -> tuple[Path, ...]:
        """Write each record to a file of a folder, with units; return the paths.

        A file has the name of its record, with - for /.

        Raises:
            LogError: a column does not exist, a file exists, or a package is missing.
        """
        out, names = Path(folder), listed(columns)
        make_folder(out)
        files = [out / f"{r.name.replace('/', '-')}.{kind}" for r in self.records]
        return tuple(r.export(f, names) for r, f in zip(self.records, files, strict=True))

    def identify(
        self,
        model: ModelSource | None = None,
        *,
        order: int | None = None,
        impulse_s: float | None = None,
        markov: Literal["least_squares", "correlation"] = "least_squares",
        band_hz: tuple[float, float] | None = None,
        truth: str | Path | None = None,
        progress: Progress | None = None,
        warn: Warn | None = None,
    ) -> Identification:
        """Identify the plant by every method that the records allow, as `levid identify` does.

        Args:
            model: MODEL.yaml or result to fit; default: the session's, else that of the rig.
            order: number of states; default: chosen from the data.
            impulse_s: length of the impulse response in s; default: chosen from the data.
            markov: estimator of the impulse response.
            band_hz: lowest and highest frequency that the fit of the declared model to a rig's
                records uses; default: as far as the excitation shows.
            truth: SIM.yaml of a simulated flight, which plots and report draw for comparison.
            progress: called with activity and completed fraction.
            warn: called with each warning; default: warnings.warn.

        Raises:
            ConfigError: a model or simulator file is wrong.
            IdentificationError: the logs cannot be identified.
            LogError: a file is not a log.
        """
        from ..identification.options import Options
        from .identify import identify

        options = Options(markov=markov, order=order, impulse_s=impulse_s, band_hz=band_hz)
        return identify(self, model, options, truth, progress, warn)

    def trace(
        self,
        model: ModelSource | None = None,
        *,
        workers: int | None = None,
        dask: str | None = None,
        progress: Progress | None = None,
        warn: Warn | None = None,
    ) -> Trace:
        """Find the physical effects that the records show and the model lacks, as `levid trace`.

        Args:
            model: MODEL.yaml, model or result to start from; default: the session's, else that of
                the rig.
            workers: number of worker processes; default: one for each processor.
            dask: address tcp://HOST:PORT of a dask.distributed scheduler to use instead.
            progress: called with activity and completed fraction.
            warn: called with each warning; default: warnings.warn.

        Raises:
            ConfigError: the model file is wrong.
            IdentificationError: the logs cannot be traced.
            ImportError: `dask` is given, and the package distributed is not installed.
        """
        from .trace import trace

        return trace(self, model, workers, dask, progress, warn)

    def plot(self, columns: Iterable[str] | None = None) -> Figure:
        """Draw the session over time; with `columns` only these signals.

        Without `columns`: states, pose, beam, forces and excitation of a flight; inputs and outputs
        of imported data.
        """
        from .signal_plot import flight_plot, signal_plot

        if columns is None and "rig.yaml" in self.steps[0].attachments:
            return flight_plot(first_flight(self.logs))
        return signal_plot(self.records, columns)

    def __repr__(self) -> str:
        lines = [f"<Session {self.name}: {self._summary()}>"]
        return "\n".join([*lines, record_table(self.steps).text()])

    def _repr_html_(self) -> str:
        head = f"<p><b>Session {html_text(self.name)}</b>: {html_text(self._summary())}</p>"
        return head + record_table(self.steps).html()

    def _summary(self) -> str:
        records = [r for r in self.steps if r.kind in _SAMPLES]
        rates = ", ".join(dict.fromkeys(f"{r.rate_hz:.6g} Hz" for r in self.steps))
        seconds = sum(r.duration_s for r in records)
        return f"{len(records)} record{'s' * (len(records) != 1)}, {seconds:.6g} s at {rates}"

    def __reduce__(self) -> tuple[type[Session], tuple[tuple[Path, ...], ModelSource | None]]:
        return Session, (self.logs, self.model)


def first_flight(logs: Sequence[Path]) -> list[Path]:
    """Return the logs in the folder of the first log: time is continuous within a flight only."""
    return [path for path in logs if path.parent == logs[0].parent]


def _with_folder(record: Record) -> str:
    return f"{record.path.parent.name}/{record.name}"


def _with_path(record: Record) -> str:
    return str(record.path)


def _logs_of(path: Path) -> list[Path]:
    if not path.is_dir():
        if path.suffix != ".mcap" and path.is_file() and path.suffix.lower() in FORMAT_OF_SUFFIX:
            raise LogError(
                f"{path}: expected signals=SIGNALS.yaml for a data file, which describes its "
                f"columns; `levid new signals {path} -o SIGNALS.yaml` writes a draft"
            )
        return [path]  # Record reports what is wrong with it
    logs = sorted(path.glob("*.mcap"))
    if logs:
        return logs
    inner = sorted(p.parent for p in path.glob("*/*.mcap"))
    hint = f"; there are logs in {inner[0]}" if inner else ""
    raise LogError(f"{path}: expected a folder with logs (*.mcap), found none{hint}")
