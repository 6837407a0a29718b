"""`levid status`, `levid land`, `levid clear`: ask the running daemon."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import click

_RIG = click.option(
    "--rig",
    "rig_path",
    type=click.Path(path_type=Path),
    help="RIG.yaml whose socket to use; the default socket unless given.",
)


@click.command("status")
@_RIG
@click.option("--json", "as_json", is_flag=True, help="Print one JSON object.")
def status(rig_path: Path | None, as_json: bool) -> int:
    """Say what the daemon is doing.

    \b
    Examples:
      levid status
      levid status --json
    """
    answer = _ask("status", rig_path)
    if as_json:
        click.echo(json.dumps(answer))
        return 0
    doing = "idle, zero force"
    if answer["session"]:
        doing = f"session {answer['session']}, {answer['step']}, {100 * answer['share']:.0f} %"
    if answer["fault"] != "NONE":
        doing = f"fault {answer['fault']} ({answer['detail']}); 'levid clear' when it is mended"
    click.echo(f"{answer['rig']} at {answer['rate_hz']:g} Hz: {doing}")
    click.echo(f"cycle {answer['cycle']}, {answer['late']} late")
    return 0


@click.command("land")
@_RIG
def land(rig_path: Path | None) -> int:
    """End the session at hand: the platform lands at once.

    \b
    Examples:
      levid land
    """
    landing = _ask("land", rig_path)["landing"]
    click.echo("landing" if landing else "nothing is flying")
    return 0


@click.command("clear")
@_RIG
def clear(rig_path: Path | None) -> int:
    """Clear a fault, once its cause is gone: the daemon takes sessions again.

    \b
    Examples:
      levid clear
    """
    cleared = _ask("clear", rig_path)["cleared"]
    click.echo("there was no fault" if cleared == "NONE" else f"cleared {cleared}")
    return 0


def _ask(op: str, rig_path: Path | None) -> dict[str, Any]:
    from ..config.rig import load_rig
    from ..daemon.client import Client, socket_path

    with Client(socket_path(load_rig(rig_path) if rig_path else None)) as client:
        return client.request(op)
