"""`levid demo`: fly, log, identify and trace the simulated rig."""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING

import click

from .excite import fly_here
from .identify import identify_logs, words
from .path_types import FOLDER
from .progress import progress, say
from .report_errors import exit_code_of_report, report_or_error
from .trace import trace_logs
from .trace import words as trace_words

if TYPE_CHECKING:
    from ..daemon.recording.log_metadata import FlightResult


@click.command("demo")
@click.option(
    "--out",
    type=FOLDER,
    help="Folder for logs and reports. Default: the next unused out/demo-N.",
)
def command(out: Path | None) -> int:
    """Fly the paper's experiment on the simulated rig, identify the plant and trace effects.

    The flight has white noise at each input in turn, at three beam positions, then a moving beam:
    ten minutes in virtual time. Then a plant is flown whose parameters differ from the model's by
    10 to 20 % and that has three effects which the model lacks, and the trace finds them from the
    logs. Prints results and the paths of the reports.

    \b
    Examples:
      levid demo
      levid demo --out out/mine
    """
    from ..config.shipped import shipped

    begin = time.perf_counter()
    folder = out or _next_unused_folder()
    white_noise = _fly("sessions/white-noise-1khz.yaml", folder / "white-noise")
    moving_beam = _fly("sessions/beam.yaml", folder / "beam")

    def draw() -> None:
        from ..report.session.session_page import session_report

        page = session_report(moving_beam.logs, folder / "beam" / "report")
        say(f"report on the moving beam: {page}")

    with progress("drawing the moving beam"):
        undrawn = report_or_error(draw)
    # The report draws the true response for comparison; identification reads the logs only.
    found, no_page = identify_logs(
        [*white_noise.logs, *moving_beam.logs],
        None,
        shipped("sims/nominal.yaml"),
        folder / "identification",
    )
    for line in words(found):
        click.echo(line)
    click.echo(f"took {time.perf_counter() - begin:.0f} s")
    if found.page is not None:
        click.echo(f"report: {found.page}")
    codes = [exit_code_of_report(error) for error in (undrawn, no_page)]
    return max(_trace(folder / "trace"), *codes)


def _trace(folder: Path) -> int:
    """Fly a plant with effects that the model lacks, and trace them; return the exit code."""
    from ..config.shipped import shipped

    begin = time.perf_counter()
    flight = _fly("sessions/trace-demo.yaml", folder, shipped("sims/undeclared.yaml"))
    traced = trace_logs(flight.logs, None, folder / "found")
    click.echo("trace of a plant with three effects that the model lacks:")
    for line in trace_words(traced.found):
        click.echo(line)
    click.echo(f"took {time.perf_counter() - begin:.0f} s")
    if traced.found.page is not None:
        click.echo(f"report: {traced.found.page}")
    return exit_code_of_report(traced.undrawn)


def _fly(name: str, out: Path, sim: Path | None = None) -> FlightResult:
    from ..config.session import load_session
    from ..config.shipped import shipped

    session = shipped(name)
    config = load_session(session)
    result = fly_here(config, session, None, sim, out)
    say(f"{config.name}: {result.cycles} cycles, {len(result.records)} records in {out}")
    return result


def _next_unused_folder() -> Path:
    number = 1
    while (Path("out") / f"demo-{number}").exists():
        number += 1
    return Path("out") / f"demo-{number}"
