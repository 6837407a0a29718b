"""`levid status`, `watch`, `levitate`, `move`, `land`, `stop`, `clear`: control the daemon."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import click

from .entry import STOPPED
from .path_types import FOLDER, RIG
from .progress import say

_RIG = click.option(
    "--rig",
    "rig_path",
    type=RIG,
    help="RIG.yaml that names the daemon's socket. Default: the default socket.",
)
_JSON = click.option("--json", "as_json", is_flag=True, help="Print one JSON object.")
_IF_GONE = click.option(
    "--if-gone",
    type=click.Choice(["go_on", "land"]),
    help="What the daemon does if this command is interrupted. Default: service.client_gone of "
    "the rig.",
)


_COUNTERS = {
    "stale": "stale readings",
    "lost": "rows lost",
}
"""Counters that `levid status` prints if they are not zero."""


@click.command("status")
@_RIG
@_JSON
def status(rig_path: Path | None, as_json: bool) -> int:
    """Print the daemon's state: session or fault, late cycles, lateness and execution time.

    \b
    Examples:
      levid status
      levid status --json
    """
    answer = _request("status", rig_path)
    if as_json:
        click.echo(json.dumps(answer))
        return 0
    click.echo(f"{answer['rig']} at {answer['rate_hz']:g} Hz: {_activity(answer)}")
    counts = [f"{answer[key]} {words}" for key, words in _COUNTERS.items() if answer[key]]
    click.echo(", ".join([f"cycle {answer['cycle']}", f"{answer['late']} late", *counts]))
    for quantity in ("lateness", "execution"):
        us = answer["timing"][f"{quantity}_us"]
        percentiles = ", ".join(f"{name} {us[name]:.0f}" for name in ("p50", "p99", "p99.9", "max"))
        click.echo(f"{quantity} in us: {percentiles}")
    if answer["late"]:
        causes = ", ".join(
            f"{n} by {k.replace('_', '-')}" for k, n in answer["timing"]["late_by"].items()
        )
        click.echo(f"late: {causes}")
    for line in _resource_problems(answer):
        click.echo(line)
    for failed in (f for f in answer["preflight"] if f["outcome"] == "failed"):
        click.echo(f"not ready to lift off: {failed['check']}: {failed['found']}")
        click.echo(f"  {failed['remedy']}")
    if answer["recording"]:
        click.echo(f"not recording: {answer['recording']}")
    if answer["fault_log"]:
        click.echo(f"last flight recording: {answer['fault_log']}")
    return 0


@click.command("watch")
@_RIG
@click.option("--json", "as_json", is_flag=True, help="Print one JSON object a line.")
@click.option(
    "--every-s",
    metavar="S",
    type=click.FloatRange(0.05, 3600),
    default=0.5,
    help="Seconds between lines. Default: 0.5.",
)
def watch(rig_path: Path | None, as_json: bool, every_s: float) -> int:
    """Print the daemon's state, one line every --every-s seconds, until Ctrl-C.

    A line shows cycle, late cycles, height z, beam position and activity.

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
        position = "" if z_m is None else f"  z {1e6 * z_m:7.1f} um"
        position += "" if beam_m is None else f"  beam {1e3 * beam_m:7.2f} mm"
        stale = f"  {answer['stale']} stale" if answer["stale"] else ""
        counts = f"{answer['cycle']:>12d}  {answer['late']:>6d} late{stale}"
        click.echo(f"{counts}{position}  {_activity(answer)}")

    _request("watch", rig_path, show, every_s=every_s)
    return 0


@click.command("levitate")
@_RIG
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
    "recorder, disk, real_time, cpu, loop or motion. May be repeated; the log says so.",
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
@_RIG
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
@_RIG
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
@_RIG
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
@_RIG
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


def _resource_problems(answer: Mapping[str, Any]) -> Iterator[str]:
    """Yield a line for each resource problem and restart since the daemon's start."""
    if answer["clients_gone"]:
        yield f"clients that disconnected during a flight: {answer['clients_gone']}"
    if answer["recorder_restarts"]:
        yield f"recorder restarts: {answer['recorder_restarts']}"
    if answer["flooded_s"]:
        yield f"control socket flooded for {answer['flooded_s']:g} s"
    if answer["memory_stalled_s"]:
        yield f"processes waited {answer['memory_stalled_s']:g} s for memory"
    if answer["stolen_s"]:
        yield f"CPU time taken by the virtual machine's host: {answer['stolen_s']:g} s"


def _activity(answer: Mapping[str, Any]) -> str:
    if answer["fault"] != "NONE":
        detail = f" ({answer['detail']})" if answer["detail"] else ""
        return f"fault {answer['fault']}{detail}; remove its cause, then run 'levid clear'"
    if answer["session"]:
        return f"session {answer['session']}, {answer['step']}, {100 * answer['share']:.0f} %"
    return {"IDLE": "idle, zero force", "LEVITATING": "levitating"}.get(
        answer["state"], str(answer["state"]).lower().replace("_", "-")
    )


def _print(answer: Mapping[str, Any], as_json: bool, summary: str) -> None:
    click.echo(json.dumps(answer) if as_json else summary)


def _if_gone(action: str | None) -> dict[str, Any]:
    return {"client_gone": action} if action else {}


def _request(
    op: str,
    rig_path: Path | None,
    on_line: Callable[[Mapping[str, Any]], None] | None = None,
    **arguments: Any,
) -> dict[str, Any]:
    from ..daemon.api.socket_paths import socket_path
    from ..daemon.client import Client

    rig = None
    if rig_path:
        from ..config.rig import load_rig  # takes 1 s: `levid stop` without --rig must not wait

        rig = load_rig(rig_path)
    with Client(socket_path(rig)) as client:
        try:
            return client.request(op, on_line, **arguments)
        except KeyboardInterrupt:
            if op in ("levitate", "move") and arguments.get("client_gone") != "land":
                say(
                    "the flight goes on or lands, as service.client_gone of the rig says; "
                    "`levid land` lands it"
                )
            raise
