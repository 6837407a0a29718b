"""`levid new`: write drafts of YAML files."""

from __future__ import annotations

from pathlib import Path

import click

from .command_group import SuggestingGroup
from .output_folder_check import quoted
from .path_types import DATA, YAML
from .progress import say


@click.group("new", cls=SuggestingGroup)
def group() -> None:
    """Write a draft of a YAML file, to be completed by hand.

    \b
    Examples:
      levid new signals motor.csv -o motor.yaml
    """


@group.command("signals")
@click.argument("file", type=DATA)
@click.option(
    "-o",
    "--out",
    type=YAML,
    help="Path of the new SIGNALS.yaml. Default: the name of FILE with .yaml, in this folder.",
)
def signals(file: Path, out: Path | None) -> int:
    """Write a draft of the SIGNALS.yaml for the data in FILE (CSV, text, NPZ, MAT).

    The draft lists the columns of FILE with units from its header, the column with the time, and
    roles where a name says it. Prints what to check, what to fill in, and the next command.

    \b
    Examples:
      levid new signals motor.csv -o motor.yaml
      levid import motor.csv --signals motor.yaml -o motor.mcap
    """
    from ..config.files.atomic_write import write_file
    from ..log.errors import LogError
    from ..log.importing.draft_signals import draft_signals

    draft = draft_signals(file)
    # Beside the data it could not be written if they are on a read-only share.
    out = Path(file.with_suffix(".yaml").name) if out is None else out
    try:
        write_file(out, draft.text, replace=False)
    except FileExistsError:
        raise LogError(
            f"{out}: exists; levid does not overwrite it: give another path with -o"
        ) from None
    click.echo(f"{out}: draft written")
    for text in draft.fill_in:
        click.echo(f"fill in: {text}")
    for text in draft.check:
        click.echo(text if text.startswith("check") else f"check: {text.replace(': check:', ':')}")
    log = out.with_suffix(".mcap")
    say(f"next: levid import {quoted(file)} --signals {quoted(out)} -o {quoted(log)}")
    return 0
