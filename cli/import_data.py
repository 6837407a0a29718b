"""`levid import`: convert measured data (CSV, text, NPZ, MAT) to logs."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from ..config.command_line import command_line, quoted
from .path_types import ANY, DATA, SIGNALS
from .progress import say

if TYPE_CHECKING:
    from ..log.importing.importer import Imported


@click.command("import")
@click.argument("file", type=DATA)
@click.option(
    "--signals",
    required=True,
    type=SIGNALS,
    help="SIGNALS.yaml: columns, units, roles and rate; `levid new signals FILE` writes a draft.",
)
@click.option("-o", "--out", required=True, type=ANY, help="Path of the new log.")
def command(file: Path, signals: Path, out: Path) -> int:
    """Convert FILE (CSV, text, NPZ, MAT) to a log that `levid identify` reads.

    Data with long gaps become several logs, OUT-1.mcap, OUT-2.mcap, and so on. Prints the number of
    samples, what was changed in the data, and the next commands.

    \b
    Examples:
      levid import motor.csv --signals motor.yaml -o motor.mcap
      levid identify motor.mcap --out out/motor
    """
    from ..log.importing.importer import import_file

    found = import_file(file, signals, out)
    for path, rows in found.logs:
        click.echo(f"{path}: {rows} samples at {found.rate_hz:.6g} Hz")
    for note in found.notes:
        click.echo(f"note: {note}")
    for warning in found.warnings:
        say(f"warning: {warning}")
    if found.missing_roles:
        roles = " and ".join(found.missing_roles)
        say(
            f"next: levid identify needs columns of role {roles}: set the role in {signals}, "
            f"delete {quoted(*(path for path, _ in found.logs))}, and import again"
        )
        return 0
    _print_next(out, found)
    return 0


def _print_next(out: Path, found: Imported) -> None:
    folder = out.with_suffix("") if out.suffix else out.with_name(f"{out.name}-identified")
    logs = [path for path, _ in found.logs]
    model = "MODEL.yaml"
    say(f"next: {command_line('identify', logs=logs, out=folder)}")
    say("With a MODEL.yaml of the plant (docs/configuration.md#modelyaml), fit its parameters:")
    say(f"      {command_line('identify', logs=logs, model=model, out=folder)}")
    say("and find effects that it lacks:")
    say(f"      {command_line('trace', logs=logs, model=model, out=folder / 'trace')}")
