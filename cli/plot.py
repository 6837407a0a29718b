"""`levid plot`: draw signals of logs over time, or their spectra."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from .path_types import ANY, LOG
from .progress import progress, say

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from ..log.log_stream import LogStream


@click.command("plot")
@click.argument("log", type=LOG)
@click.argument("more", nargs=-1, type=LOG, metavar="[LOG]... [SIGNAL]...")
@click.option(
    "-o",
    "--out",
    type=ANY,
    help="FILE.svg, .png or .pdf; default: an SVG file beside the (first) log.",
)
@click.option(
    "--begin-s",
    type=float,
    metavar="SECONDS",
    help="First time in s, as in the log's time_s; of several logs since each began.",
)
@click.option("--end-s", type=float, metavar="SECONDS", help="Last time in s, likewise.")
@click.option("--spectrum", is_flag=True, help="Draw amplitude spectral densities instead.")
def command(
    log: Path,
    more: tuple[Path, ...],
    out: Path | None,
    begin_s: float | None,
    end_s: float | None,
    spectrum: bool,
) -> int:
    """Draw SIGNALS of LOGs over time; default: pose, beam, coil forces, excitation.

    SIGNALS are fields (gap_m), elements (gap_m_3) or groups (pose, coils); `levid info LOG
    --columns` lists the fields. Long signals are bands from minimum to maximum: no peak is lost.
    Several logs share the panels, each over the time since it began; default: pose. Prints the path
    of the figure.

    \b
    Examples:
      levid plot out/first/02-left-psi.mcap
      levid plot out/first/02-left-psi.mcap pose gap_m_0 -o psi.png --begin-s 10 --end-s 12
      levid plot out/first/02-left-psi.mcap pose --spectrum -o psi.pdf
      levid plot out/monday/02-left-psi.mcap out/friday/02-left-psi.mcap gap_m_0 --spectrum
    """
    from ..report.logs.signal_figure import check_format, save_figure

    others = [path for path in more if _is_log(path)]
    signals = [path.as_posix() for path in more if not _is_log(path)]
    ending = "-compared" if others else ""
    path = out or log.with_name(f"{log.stem}{ending}{'-spectrum' if spectrum else ''}.svg")
    check_format(path)
    with progress("drawing") as report:
        report("", 0.3)
        if others:
            figure = _of_logs((log, *others), signals, begin_s, end_s, spectrum)
        else:
            figure = _of_log(log, signals, begin_s, end_s, spectrum)
        save_figure(figure, path)
    click.echo(str(path))
    return 0


def _is_log(path: Path) -> bool:
    """Return whether an argument is a log; signals have neither an ending nor a folder."""
    return bool(path.suffix) or len(path.parts) > 1


def _of_log(
    log: Path, signals: Sequence[str], begin_s: float | None, end_s: float | None, spectrum: bool
) -> Figure:
    from ..log.log_stream import LogStream
    from ..report.logs.signal_data import (
        default_columns,
        named_columns,
        signal_spectra,
        signals_over_time,
        without_zero,
    )
    from ..report.logs.signal_figure import spectrum_figure, time_figure

    stream = LogStream(log)
    columns = named_columns(stream, signals) if signals else default_columns(stream)
    if spectrum:
        return spectrum_figure(signal_spectra(stream, columns, begin_s, end_s))
    found = signals_over_time(stream, columns, begin_s, end_s)
    return time_figure(found if signals else without_zero(found))


def _of_logs(
    logs: Sequence[Path],
    signals: Sequence[str],
    begin_s: float | None,
    end_s: float | None,
    spectrum: bool,
) -> Figure:
    from ..identification.records.one_plant import different_plants
    from ..log.exporting.columns import groups_of
    from ..log.log_stream import LogStream
    from ..report.logs.signal_data import (
        default_columns,
        named_columns,
        signal_spectra,
        signals_over_time,
    )
    from ..report.logs.signal_figure import spectrum_figure_of_logs, time_figure_of_logs

    streams = dict(zip(_distinct_names(logs), map(LogStream, logs), strict=True))
    if differ := different_plants(streams.values()):
        say(f"note: these logs are not of one plant: {differ}")
    first = next(iter(streams.values()))
    pose = ["pose"] if "pose" in groups_of(first) else [c.name for c in default_columns(first)]
    found: dict[str, Any] = {}
    for name, stream in streams.items():
        columns = named_columns(stream, signals or pose)
        if spectrum:
            found[name] = signal_spectra(stream, columns, *_of_time(stream, begin_s, end_s))
        else:
            found[name] = signals_over_time(stream, columns, *_of_time(stream, begin_s, end_s))
    return spectrum_figure_of_logs(found) if spectrum else time_figure_of_logs(found)


def _of_time(
    log: LogStream, begin_s: float | None, end_s: float | None
) -> tuple[float | None, float | None]:
    """Return times since a log's first row as values of its time_s, in s."""
    from ..log.exporting.export_log import time_of

    first = log.first_block()
    first_s = 0.0 if first is None else float(time_of(log, first)[0])
    return (
        None if begin_s is None else first_s + begin_s,
        None if end_s is None else first_s + end_s,
    )


def _distinct_names(logs: Sequence[Path]) -> list[str]:
    """Return the names of logs, preceded by folders until all differ.

    Raises:
        click.UsageError: a log is there twice.
    """
    whole = [log.resolve().with_suffix("").parts for log in logs]
    if len(set(whole)) < len(whole):
        raise click.UsageError("expected different logs, found one twice")
    count = 1
    while len({parts[-count:] for parts in whole}) < len(whole):
        count += 1
    return ["/".join(parts[-count:]) for parts in whole]
