"""`levid demo`: the main job from end to end, on the simulated rig."""

from __future__ import annotations

import time
from pathlib import Path

import click

from ..config.rig import load_rig
from ..config.session import load_session
from ..config.shipped import shipped
from ..daemon.flight import FlightResult
from ..daemon.virtual import fly_virtually
from ..report.session import session_report
from .identify import identify_logs, words
from .progress import console, progress


@click.command("demo")
@click.option(
    "--out",
    type=click.Path(path_type=Path),
    help="Folder for logs and reports; the next free out/demo-N unless given.",
)
def command(out: Path | None) -> int:
    """Fly the paper's experiment on the simulated rig, identify it from its logs, show pictures.

    White noise at each input in turn at three beam positions, then a moving beam: ten minutes of
    flight, flown in virtual time. Prints where the report lies.

    \b
    Examples:
      levid demo
      levid demo --out out/mine
    """
    begin = time.perf_counter()
    folder = out or _next_free()
    excited = _fly("sessions/white-noise-1khz.yaml", folder / "white-noise")
    moved = _fly("sessions/beam.yaml", folder / "beam")
    # The truth is drawn beneath the results; identification gets the logs and nothing else.
    result, page = identify_logs(
        excited.logs, None, shipped("sims/nominal.yaml"), folder / "white-noise" / "identification"
    )
    for line in words(result):
        click.echo(line)
    with progress("drawing the moving beam"):
        beam_page = session_report(moved.logs, folder / "beam" / "report")
    click.echo(f"took {time.perf_counter() - begin:.0f} s")
    click.echo(f"moving beam: {beam_page}")
    click.echo(f"report: {page}")
    return 0


def _fly(name: str, out: Path) -> FlightResult:
    rig_file, session_file = shipped("rigs/loopback.yaml"), shipped(name)
    session = load_session(session_file)
    with progress(f"flying {session.name}") as report:
        result = fly_virtually(
            load_rig(rig_file),
            rig_file,
            session,
            session_file.read_bytes(),
            out,
            lambda step, done, total: report(step, done / total),
        )
    console.print(f"{session.name}: {result.cycles} cycles, {len(result.records)} records in {out}")
    return result


def _next_free() -> Path:
    number = 1
    while (Path("out") / f"demo-{number}").exists():
        number += 1
    return Path("out") / f"demo-{number}"
