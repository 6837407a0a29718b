"""`levid status`, `levitate`, `move`, `land`, `stop`, `clear`, `watch`: ask the running daemon."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import click

from .progress import say

_RIG = click.option(
    "--rig",
    "rig_path",
    type=click.Path(path_type=Path),
    help="RIG.yaml whose socket to use; the default socket unless given.",
)
_JSON = click.option("--json", "as_json", is_flag=True, help="Print one JSON object.")
_GONE = click.option(
    "--if-gone",
    type=click.Choice(["go_on", "land"]),
    help="What the flight does if this command is interrupted; as the rig says unless given.",
)


_COUNTED = {
    "stale": "readings not in time",
    "lost": "rows lost",
}
"""What `levid status` tells of if there was any."""


@click.command("status")
@_RIG
@_JSON
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
    click.echo(f"{answer['rig']} at {answer['rate_hz']:g} Hz: {_doing(answer)}")
    counts = [f"{answer[key]} {words}" for key, words in _COUNTED.items() if answer[key]]
    click.echo(", ".join([f"cycle {answer['cycle']}", f"{answer['late']} late", *counts]))
    for what in ("lateness", "execution"):
        us = answer["timing"][f"{what}_us"]
        shares = ", ".join(f"{name} {us[name]:.0f}" for name in ("p50", "p99", "p99.9", "max"))
        click.echo(f"{what} in us: {shares}")
    if answer["late"]:
        by = ", ".join(
            f"{n} by {k.replace('_', '-')}" for k, n in answer["timing"]["late_by"].items()
        )
        click.echo(f"late: {by}")
    for line in _burdens(answer):
        click.echo(line)
    if answer["recording"]:
        click.echo(f"not recording: {answer['recording']}")
    if answer["fault_log"]:
        click.echo(f"last flight recording: {answer['fault_log']}")
    return 0


@click.command("watch")
@_RIG
@click.option("--json", "as_json", is_flag=True, help="Print one JSON object a line.")
@click.option("--every-s", type=click.FloatRange(0.05, 3600), default=0.5, help="Seconds between.")
def watch(rig_path: Path | None, as_json: bool, every_s: float) -> int:
    """Say what the daemon is doing, again and again, until Ctrl-C.

    \b
    Examples:
      levid watch
      levid watch --every-s 5 --json >> flights.jsonl
    """

    def show(answer: Mapping[str, Any]) -> None:
        if as_json:
            click.echo(json.dumps(answer))
            return
        z_m, beam_m = answer["z_m"], answer["beam_m"]
        where = "" if z_m is None else f"  z {1e6 * z_m:7.1f} um"
        where += "" if beam_m is None else f"  beam {1e3 * beam_m:7.2f} mm"
        stale = f"  {answer['stale']} stale" if answer["stale"] else ""
        late = f"{answer['cycle']:>12d}  {answer['late']:>6d} late{stale}"
        click.echo(f"{late}{where}  {_doing(answer)}")

    _ask("watch", rig_path, show, every_s=every_s)
    return 0


@click.command("levitate")
@_RIG
@_JSON
@click.option("--out", type=click.Path(path_type=Path), help="Folder for a log of the flight.")
@click.option(
    "--check-coils/--no-check-coils",
    default=None,
    help="Push each coil, once up, and see what it moves; until the coils are known unless given.",
)
@_GONE
def levitate(
    rig_path: Path | None,
    as_json: bool,
    out: Path | None,
    check_coils: bool | None,
    if_gone: str | None,
) -> int:
    """Lift off and hold the working point until `levid land`.

    \b
    Examples:
      levid levitate
      levid levitate --check-coils --out out/by-hand
    """
    from ..daemon.recording.session_logs import in_doubt

    more: dict[str, Any] = {"out": str(out.resolve())} if out else {}
    more |= _if_gone(if_gone)
    if check_coils is not None:
        more["levitate"] = {"check_coils": {} if check_coils else False}
    answer = _ask("levitate", rig_path, **more)
    if doubt := in_doubt(answer["unjudged_coils"]):
        say(doubt)
    _tell(answer, as_json, "landed before it was up" if answer["stopped"] else "levitating")
    return 1 if answer["stopped"] else 0


@click.command("move")
@click.option("--beam-m", type=float, help="Where the beam is to go.")
@click.option("--rotor-rad", type=float, help="Where the rotor is to go.")
@_RIG
@_JSON
@_GONE
def move(
    beam_m: float | None,
    rotor_rad: float | None,
    rig_path: Path | None,
    as_json: bool,
    if_gone: str | None,
) -> int:
    """Move beam, rotor or both while levitating, and wait until they are there.

    \b
    Examples:
      levid move --beam-m 0.05
      levid move --beam-m -0.02 --rotor-rad 1.57
    """
    wanted = {"beam_m": beam_m, "rotor_rad": rotor_rad}
    given = {key: value for key, value in wanted.items() if value is not None}
    if not given:
        raise click.UsageError("expected --beam-m, --rotor-rad or both")
    answer = _ask("move", rig_path, move=given, **_if_gone(if_gone))
    _tell(answer, as_json, "landed before it was there" if answer["stopped"] else "there")
    return 1 if answer["stopped"] else 0


@click.command("land")
@_RIG
@_JSON
def land(rig_path: Path | None, as_json: bool) -> int:
    """End the session at hand: the platform lands at once.

    \b
    Examples:
      levid land
    """
    answer = _ask("land", rig_path)
    _tell(answer, as_json, "landing" if answer["landing"] else "nothing is flying")
    return 0


@click.command("stop")
@_RIG
@_JSON
def stop(rig_path: Path | None, as_json: bool) -> int:
    """Zero force at once: the platform drops onto its stops, and the daemon is in fault STOPPED.

    It works whatever else the daemon is doing. `levid clear` takes it back.

    \b
    Examples:
      levid stop
    """
    _tell(_ask("stop", rig_path), as_json, "zero force; 'levid clear' to go on")
    return 0


@click.command("clear")
@_RIG
@_JSON
def clear(rig_path: Path | None, as_json: bool) -> int:
    """Clear a fault, once its cause is gone: the daemon takes sessions again.

    \b
    Examples:
      levid clear
    """
    answer = _ask("clear", rig_path)
    cleared = answer["cleared"]
    _tell(answer, as_json, "there was no fault" if cleared == "NONE" else f"cleared {cleared}")
    return 0


def _burdens(answer: Mapping[str, Any]) -> Iterator[str]:
    """Yield what has weighed on the daemon since its start, in words."""
    if answer["clients_gone"]:
        yield f"clients gone in mid-flight: {answer['clients_gone']}"
    if answer["recorder_restarts"]:
        yield f"recorders started anew: {answer['recorder_restarts']}"
    if answer["flooded_s"]:
        yield f"control socket flooded for {answer['flooded_s']:g} s"
    if answer["memory_stalled_s"]:
        yield f"processes waited for memory for {answer['memory_stalled_s']:g} s"
    if answer["stolen_s"]:
        yield f"the host of this virtual machine kept its processors for {answer['stolen_s']:g} s"


def _doing(answer: Mapping[str, Any]) -> str:
    if answer["fault"] != "NONE":
        detail = f" ({answer['detail']})" if answer["detail"] else ""
        return f"fault {answer['fault']}{detail}; 'levid clear' when it is mended"
    if answer["session"]:
        return f"session {answer['session']}, {answer['step']}, {100 * answer['share']:.0f} %"
    return {"IDLE": "idle, zero force", "LEVITATING": "levitating"}.get(
        answer["state"], str(answer["state"]).lower().replace("_", "-")
    )


def _tell(answer: Mapping[str, Any], as_json: bool, words: str) -> None:
    click.echo(json.dumps(answer) if as_json else words)


def _if_gone(what: str | None) -> dict[str, Any]:
    return {"client_gone": what} if what else {}


def _ask(
    op: str,
    rig_path: Path | None,
    on_line: Callable[[Mapping[str, Any]], None] | None = None,
    **more: Any,
) -> dict[str, Any]:
    from ..daemon.api.socket_paths import socket_path
    from ..daemon.client import Client

    rig = None
    if rig_path:
        from ..config.rig import load_rig  # takes a second: not before a stop that needs none

        rig = load_rig(rig_path)
    with Client(socket_path(rig)) as client:
        try:
            return client.request(op, on_line, **more)
        except KeyboardInterrupt:
            if op in ("levitate", "move") and more.get("client_gone") != "land":
                say("the daemon goes on as it is configured; 'levid land' lands")
            raise
