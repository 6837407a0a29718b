"""`levid import`: convert measured data (CSV, text, NPZ, MAT) to a log."""

from __future__ import annotations

from pathlib import Path

import click

from .output_folder_check import quoted
from .progress import say


@click.command("import")
@click.argument("file", type=click.Path(path_type=Path))
@click.option(
    "--signals",
    required=True,
    type=click.Path(path_type=Path),
    help="SIGNALS.yaml: columns, units, roles and rate; examples in config/signals/.",
)
@click.option(
    "-o", "--out", required=True, type=click.Path(path_type=Path), help="Path of the new log."
)
def command(file: Path, signals: Path, out: Path) -> int:
    """Convert FILE (CSV, whitespace text, NPZ, MAT) to a log that `levid identify` reads.

    Prints the number of samples and the next command.

    \b
    Examples:
      levid import arm.dat --signals config/signals/cd-player-arm.yaml -o arm.mcap
      levid identify arm.mcap --out out/arm
    """
    from ..log.importer import import_file

    samples = import_file(file, signals, out)
    click.echo(f"{out}: {samples} samples")
    folder = out.with_suffix("") if out.suffix else out.with_name(f"{out.name}-identified")
    say(f"next: levid identify {quoted(out)} --out {quoted(folder)}")
    return 0
