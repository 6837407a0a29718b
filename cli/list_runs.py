"""`levid list`: list the flights below a folder, and their results."""

from __future__ import annotations

import json
from collections.abc import Sequence
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING

import click

from ..config.escaping import one_line
from .info import fault_name
from .path_types import FOLDER
from .progress import progress, say
from .text_table import text_table

if TYPE_CHECKING:
    from ..log.catalogue.catalogue import Run


@click.command("list")
@click.argument("folder", default="out", type=FOLDER)
@click.option("--rig", metavar="NAME", help="Only flights of this rig.")
@click.option("--session", metavar="NAME", help="Only flights of this session.")
@click.option(
    "--since",
    type=click.DateTime(["%Y-%m-%d", "%Y-%m-%dT%H:%M", "%Y-%m-%d %H:%M"]),
    metavar="DATE",
    help="Only flights since this day, or day and time.",
)
@click.option("--parquet", is_flag=True, help="Also write FOLDER/catalogue.parquet.")
@click.option("--json", "as_json", is_flag=True, help="Print one JSON object a line and flight.")
def command(
    folder: Path,
    rig: str | None,
    session: str | None,
    since: datetime | None,
    parquet: bool,
    as_json: bool,
) -> int:
    """List the flights below FOLDER (default: out), newest first, each with its results.

    FOLDER/catalogue.jsonl holds the list; only new and changed flights are read again. Any program
    that reads JSON lines or Parquet can query it: see docs/export-and-compare.md.

    \b
    Examples:
      levid list
      levid list out --rig loopback --since 2026-11-01
      levid list /var/lib/levid --json
      levid list out --parquet
    """
    from ..config.base import ConfigError
    from ..log.catalogue.catalogue import plain_run, update_catalogue

    if not folder.is_dir():
        found = "a file" if folder.exists() else "none"
        raise ConfigError(f"{folder}: expected a folder with flights in it, found {found}")
    with progress("reading") as report:
        runs = update_catalogue(folder, report, _say_unreadable)
    if parquet:
        from ..log.catalogue.parquet_table import write_catalogue_parquet

        write_catalogue_parquet(folder / "catalogue.parquet", runs)
        say(f"catalogue: {folder / 'catalogue.parquet'}")
    shown = [run for run in runs if _wanted(run, rig, session, since)]
    if as_json:
        for run in shown:
            click.echo(json.dumps(plain_run(run)))
        return 0
    for line in _lines(folder, shown):
        click.echo(line)
    if not shown:
        say(f"{folder}: no flights" + (f" of these, {len(runs)} others" if runs else ""))
    return 0


def _say_unreadable(error: OSError) -> None:
    say(f"note: {error.filename}: not searched: {error.strerror}")


def _wanted(run: Run, rig: str | None, session: str | None, since: datetime | None) -> bool:
    summary = run.summary
    return (
        rig in (None, summary.rig)
        and session in (None, summary.session)
        and (since is None or datetime.fromisoformat(summary.flown) >= since.astimezone())
    )


def _lines(folder: Path, runs: Sequence[Run]) -> list[str]:
    """Return a table of flights; results and notes follow each flight, indented."""
    rows = [_row(run) for run in runs]
    head = ("flown", "folder", "rig", "session", "rec", "length s", "rate Hz", "remarks")
    table = text_table(head, rows, right=(4, 5, 6)) if rows else []
    lines = table[:1]
    for line, run in zip(table[1:], runs, strict=True):
        lines.append(line)
        if run.summary.note:
            lines.append(f"    note: {run.summary.note}")
        seen: set[str] = set()
        for result in run.results:
            again = result.command in seen
            seen.add(result.command)
            if not again:
                lines.append(f"    {result.command}: {result.outcome}")
                lines.append(f"      {one_line(str(folder / result.path))}")
        older = len(run.results) - len(seen)
        if older:
            lines.append(f"    and {older} older result{'s' * (older > 1)}")
    return lines


def _row(run: Run) -> tuple[str, ...]:
    s = run.summary
    remarks = [f"FAULT {fault_name(s.fault)}"] if s.fault else []
    remarks += [f"{s.incomplete} incomplete"] if s.incomplete else []
    remarks += [f"{s.unflown} step{'s' * (s.unflown != 1)} not flown"] if s.unflown else []
    remarks += [f"{s.unreadable} unreadable"] if s.unreadable else []
    remarks += ["virtual"] if s.virtual else []
    return (
        f"{datetime.fromisoformat(s.flown).astimezone():%Y-%m-%d %H:%M}",
        s.folder,
        s.rig,
        s.session,
        str(s.records),
        f"{s.length_s:.1f}",
        f"{s.rate_hz:g}",
        ", ".join(remarks),
    )
