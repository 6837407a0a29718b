"""`levid new`: write YAML files to edit, from the shipped ones or from a data file."""

from __future__ import annotations

import re
from pathlib import Path

import click

from ..config.command_line import command_line
from ..config.shipped import find_file, shipped_file, shipped_names
from .command_group import SuggestingGroup
from .path_types import DATA, YAML, ShippedName
from .progress import say

_NAME = re.compile(r"^[A-Za-z0-9][A-Za-z0-9._-]*$")
_NAMED_FILE = re.compile(r"\.\./\w+/([\w-]+)\.yaml")
"""A shipped file as another shipped file names it: relative to its own folder."""
_OUT = "Path of the new file. Default: NAME.yaml in this folder."


@click.group("new", cls=SuggestingGroup)
def group() -> None:
    """Write a YAML file to edit: a copy of a shipped file, or a draft for a data file.

    \b
    Examples:
      levid new rig loopback -o my-rig.yaml
      levid new session trace-demo -o my-session.yaml
      levid new signals motor.csv -o motor.yaml
    """


def _copying(kind: str, what: str, example: str) -> None:
    """Add the command that copies a shipped file of one kind."""

    @group.command(
        kind,
        short_help=f"Copy a shipped {kind}: {', '.join(shipped_names(kind))}.",
        help=f"""Write a copy of the shipped {kind} NAME, to be edited: {what}.

        The key `name` becomes the name of the new file. The copy works in every folder. An existing
        file is not overwritten. Prints the next command.

        Shipped: {", ".join(shipped_names(kind))}.

        \b
        Examples:
          levid new {kind} {example} -o my-{kind}.yaml
          levid check my-{kind}.yaml
        """,
    )
    @click.argument("name", type=ShippedName(kind))
    @click.option("-o", "--out", type=YAML, help=_OUT)
    def copy(name: str, out: Path | None) -> int:
        return _copy(name, kind, out)


_copying("rig", "geometry, gains, limits, backends", "loopback")
_copying("session", "what is flown", "beam")
_copying("model", "the declared model that identification fits", "rig")
_copying("sim", "the simulated plant", "nominal")


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

    FILE may also be the name of a shipped SIGNALS.yaml, which is copied.

    \b
    Examples:
      levid new signals motor.csv -o motor.yaml
      levid import motor.csv --signals motor.yaml -o motor.mcap
    """
    from ..log.importing.draft_signals import draft_signals

    if find_file(file, "signals") != file:
        return _copy(str(file), "signals", out)
    draft = draft_signals(file)
    # Beside the data it could not be written if they are on a read-only share.
    out = Path(file.with_suffix(".yaml").name) if out is None else out
    _write(out, draft.text)
    click.echo(f"{out}: draft written")
    for text in draft.fill_in:
        click.echo(f"fill in: {text}")
    for text in draft.check:
        click.echo(text if text.startswith("check") else f"check: {text.replace(': check:', ':')}")
    log = out.with_suffix(".mcap")
    say(f"next: {command_line('import', file, signals=out, out=log)}")
    return 0


def _copy(name: str, kind: str, out: Path | None) -> int:
    source = shipped_file(name, kind)
    assert source is not None  # the argument's type refuses other names
    out = Path(source.name) if out is None else out
    _write(out, copy_of(source.read_text(encoding="utf-8"), out.stem))
    click.echo(f"{out}: copy of the shipped {kind} {source.stem} written")
    say(f"next: {command_line('check', out)}")
    return 0


def copy_of(text: str, name: str) -> str:
    """Return the text of a shipped file for any folder, with the key `name` changed to `name`.

    Shipped files that it names relative to its folder are named by their shipped names.
    """
    text = _NAMED_FILE.sub(r"\1", text)
    return re.sub(r"(?m)^name: \S+", f"name: {name}", text) if _NAME.match(name) else text


def _write(out: Path, text: str) -> None:
    from ..config.files.atomic_write import write_file
    from ..log.errors import LogError

    try:
        write_file(out, text, replace=False)
    except FileExistsError:
        raise LogError(
            f"{out}: exists; levid does not overwrite it: give another path with -o"
        ) from None
