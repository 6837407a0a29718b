"""`levid demo`: the main job from end to end, on the simulated rig."""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING

import click

from .excite import fly_here
from .identify import identify_logs, words
from .progress import progress, say
from .trace import trace_logs
from .trace import words as trace_words

if TYPE_CHECKING:
    from ..daemon.recording.session_logs import FlightResult


@click.command("demo")
@click.option(
    "--out",
    type=click.Path(path_type=Path),
    help="Folder for logs and reports; the next free out/demo-N unless given.",
)
def command(out: Path | None) -> int:
    """Fly the paper's experiment on the simulated rig, identify it from its logs, show pictures.

    White noise at each input in turn at three beam positions, then a moving beam: ten minutes of
    flight, flown in virtual time. At the end a plant does what its model does not know, and is
    traced from its logs. Prints where the reports lie.

    \b
    Examples:
      levid demo
      levid demo --out out/mine
    """
    from ..config.shipped import shipped
    from ..report.session.session_page import session_report

    begin = time.perf_counter()
    folder = out or _next_free()
    excited = _fly("sessions/white-noise-1khz.yaml", folder / "white-noise")
    moved = _fly("sessions/beam.yaml", folder / "beam")
    with progress("drawing the moving beam"):
        beam_page = session_report(moved.logs, folder / "beam" / "report")
    # The truth is drawn beneath the results; identification gets the logs and nothing else.
    found, page = identify_logs(
        [*excited.logs, *moved.logs],
        None,
        shipped("sims/nominal.yaml"),
        folder / "identification",
    )
    for line in words(found):
        click.echo(line)
    click.echo(f"took {time.perf_counter() - begin:.0f} s")
    click.echo(f"moving beam: {beam_page}")
    click.echo(f"report: {page}")
    _trace(folder / "trace")
    return 0


def _trace(folder: Path) -> None:
    """Fly a plant with effects that no model knows, and trace them."""
    from ..config.shipped import shipped

    begin = time.perf_counter()
    flown = _fly("sessions/trace-demo.yaml", folder, shipped("sims/undeclared.yaml"))
    traced = trace_logs(flown.logs, None, folder / "found")
    click.echo("trace of a plant that does what its model does not know:")
    for line in trace_words(traced.found):
        click.echo(line)
    click.echo(f"took {time.perf_counter() - begin:.0f} s")
    if traced.undrawn is not None:
        raise traced.undrawn
    click.echo(f"report: {traced.page}")


def _fly(name: str, out: Path, sim: Path | None = None) -> FlightResult:
    from ..config.session import load_session
    from ..config.shipped import shipped

    session = shipped(name)
    config = load_session(session)
    result = fly_here(config, session, None, sim, out)
    say(f"{config.name}: {result.cycles} cycles, {len(result.records)} records in {out}")
    return result


def _next_free() -> Path:
    number = 1
    while (Path("out") / f"demo-{number}").exists():
        number += 1
    return Path("out") / f"demo-{number}"
