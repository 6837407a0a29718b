"""`levid status`, `levitate`, `move`, `land`, `stop`, `clear`: control the daemon."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import click

from .entry import STOPPED
from .path_types import FOLDER
from .progress import say
from .rig_socket import rig_option, socket_of
from .status_text import status_lines

_JSON = click.option("--json", "as_json", is_flag=True, help="Print one JSON object.")
_IF_GONE = click.option(
    "--if-gone",
    type=click.Choice(["go_on", "land"]),
    help="What the daemon does if this command is interrupted. Default: service.client_gone of "
    "the rig.",
)


@click.command("status")
@rig_option
@_JSON
def status(rig_path: Path | None, as_json: bool) -> int:
    """Print the daemon's state: fault or session, pose, beam, rotor, coils, gaps, lateness.

    Values are those of the newest cycle, with the digits that their noise supports.

    \b
    Examples:
      levid status
      levid status --json
    """
    answer = _request("status", rig_path)
    if as_json:
        click.echo(json.dumps(answer))
        return 0
    for line in status_lines(answer):
        click.echo(line)
    return 0


@click.command("levitate")
@rig_option
@_JSON
@click.option("--out", type=FOLDER, help="Folder for a log. Default: no log.")
@click.option(
    "--check-coils/--no-check-coils",
    default=None,
    help="After lift-off, push each coil and measure the response, or never do so. Default: check "
    "the coils at the first lift-off after the daemon's start and after each `levid clear`.",
)
@_IF_GONE
@click.option(
    "--override",
    multiple=True,
    metavar="CHECK",
    help="Fly although this check before lift-off failed (`levid status` lists them): devices, "
    "amplifiers, recorder, disk, real_time, cpu, loop or motion. May be repeated; the log says so.",
)
def levitate(
    rig_path: Path | None,
    as_json: bool,
    out: Path | None,
    check_coils: bool | None,
    if_gone: str | None,
    override: tuple[str, ...],
) -> int:
    """Lift off and hold the working point until `levid land`; wait until it levitates.

    \b
    Examples:
      levid levitate
      levid levitate --check-coils --out out/by-hand
    """
    arguments: dict[str, Any] = {"out": str(out.resolve())} if out else {}
    arguments |= _if_gone(if_gone)
    if override:
        arguments["override"] = list(override)
    if check_coils is not None:
        arguments["levitate"] = {"check_coils": {} if check_coils else False}
    answer = _request("levitate", rig_path, **arguments)
    if answer["coil_check"]:
        say(answer["coil_check"])
    landed = "landed on request before the lift-off was complete"
    _print(answer, as_json, landed if answer["stopped"] else "levitating")
    return 1 if answer["stopped"] else 0


@click.command("move")
@click.option("--beam-m", metavar="M", type=float, help="Target position of the beam in m.")
@click.option("--rotor-rad", metavar="RAD", type=float, help="Target angle of the rotor in rad.")
@rig_option
@_JSON
@_IF_GONE
def move(
    beam_m: float | None,
    rotor_rad: float | None,
    rig_path: Path | None,
    as_json: bool,
    if_gone: str | None,
) -> int:
    """Move beam, rotor or both while levitating; wait until the move is complete.

    \b
    Examples:
      levid move --beam-m 0.05
      levid move --beam-m -0.02 --rotor-rad 1.57
    """
    targets = {"beam_m": beam_m, "rotor_rad": rotor_rad}
    given = {key: value for key, value in targets.items() if value is not None}
    if not given:
        raise click.UsageError("expected --beam-m, --rotor-rad or both, found neither")
    answer = _request("move", rig_path, move=given, **_if_gone(if_gone))
    landed = "landed on request before the move was complete"
    _print(answer, as_json, landed if answer["stopped"] else "move complete")
    return 1 if answer["stopped"] else 0


@click.command("land")
@rig_option
@_JSON
def land(rig_path: Path | None, as_json: bool) -> int:
    """End the running session: the platform lands now.

    \b
    Examples:
      levid land
    """
    answer = _request("land", rig_path)
    _print(answer, as_json, "landing" if answer["landing"] else "no flight to land")
    return 0


@click.command("stop")
@rig_option
@_JSON
def stop(rig_path: Path | None, as_json: bool) -> int:
    """Set all coil forces to zero immediately; the platform drops onto its stops.

    It works in every state. The daemon is then in fault STOPPED until `levid clear`.

    \b
    Examples:
      levid stop
    """
    _print(_request("stop", rig_path), as_json, STOPPED)
    return 0


@click.command("clear")
@rig_option
@_JSON
def clear(rig_path: Path | None, as_json: bool) -> int:
    """Clear a fault after its cause is removed, so that the daemon accepts sessions again.

    \b
    Examples:
      levid clear
    """
    answer = _request("clear", rig_path)
    cleared = answer["cleared"]
    _print(answer, as_json, "no fault to clear" if cleared == "NONE" else f"cleared {cleared}")
    return 0


def _print(answer: Mapping[str, Any], as_json: bool, summary: str) -> None:
    click.echo(json.dumps(answer) if as_json else summary)


def _if_gone(action: str | None) -> dict[str, Any]:
    return {"client_gone": action} if action else {}


def _request(
    op: str,
    rig_path: Path | None,
    **arguments: Any,
) -> dict[str, Any]:
    from ..daemon.client import Client

    with Client(socket_of(rig_path)) as client:
        try:
            return client.request(op, **arguments)
        except KeyboardInterrupt:
            if op in ("levitate", "move") and arguments.get("client_gone") != "land":
                say(
                    "the flight goes on or lands, as service.client_gone of the rig says; "
                    "`levid land` lands it"
                )
            raise
