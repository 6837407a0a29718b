"""`levid plot`: draw signals of a log over time, or their spectra."""

from __future__ import annotations

from pathlib import Path

import click

from .path_types import ANY, LOG
from .progress import progress


@click.command("plot")
@click.argument("log", type=LOG)
@click.argument("signals", nargs=-1, metavar="[SIGNAL]...")
@click.option(
    "-o",
    "--out",
    type=ANY,
    help="FILE.svg, .png or .pdf; default: an SVG file beside the log.",
)
@click.option(
    "--begin-s", type=float, metavar="SECONDS", help="First time in s, as in the log's time_s."
)
@click.option(
    "--end-s", type=float, metavar="SECONDS", help="Last time in s, as in the log's time_s."
)
@click.option("--spectrum", is_flag=True, help="Draw amplitude spectral densities instead.")
def command(
    log: Path,
    signals: tuple[str, ...],
    out: Path | None,
    begin_s: float | None,
    end_s: float | None,
    spectrum: bool,
) -> int:
    """Draw SIGNALS of LOG over time; default: pose, beam, coil forces, excitation.

    SIGNALS are fields (gap_m), elements (gap_m_3) or groups (pose, coils); `levid info LOG
    --columns` lists the fields. Long signals are bands from minimum to maximum: no peak is lost.
    Prints the path of the figure.

    \b
    Examples:
      levid plot out/first/02-psi.mcap
      levid plot out/first/02-psi.mcap pose gap_m_0 -o psi.png --begin-s 10 --end-s 12
      levid plot out/first/02-psi.mcap pose --spectrum -o psi.pdf
    """
    from ..log.log_stream import LogStream
    from ..report.logs.signal_data import (
        default_columns,
        named_columns,
        signal_spectra,
        signals_over_time,
        without_zero,
    )
    from ..report.logs.signal_figure import check_format, save_figure, spectrum_figure, time_figure

    path = out or log.with_name(f"{log.stem}{'-spectrum' if spectrum else ''}.svg")
    check_format(path)
    stream = LogStream(log)
    columns = named_columns(stream, signals) if signals else default_columns(stream)
    with progress("drawing") as report:
        report("", 0.3)
        if spectrum:
            figure = spectrum_figure(signal_spectra(stream, columns, begin_s, end_s))
        else:
            found = signals_over_time(stream, columns, begin_s, end_s)
            figure = time_figure(found if signals else without_zero(found))
        save_figure(figure, path)
    click.echo(str(path))
    return 0
