"""`levid excite`: fly a session on the running daemon or in virtual time in this process."""

from __future__ import annotations

import codecs
import contextlib
import os
from pathlib import Path
from typing import TYPE_CHECKING

import click

from ..config.command_line import command_line
from .full_option import full_option
from .output_folder_check import naming_out
from .path_types import FOLDER, RIG, SESSION, SIM
from .progress import progress, say
from .report_errors import exit_code_of_report, report_or_error

if TYPE_CHECKING:
    from ..config.session import SessionConfig
    from ..daemon.recording.log_metadata import FlightResult

_REPORT_FOLDERS = {"identify": "identification", "trace": "trace"}
"""Report folder of each command that a session's `then` can name."""


@click.command("excite")
@click.argument("session", type=SESSION)
@click.option(
    "--rig",
    "rig_path",
    type=RIG,
    help="RIG.yaml to fly. Default: the daemon's rig; with --virtual the shipped loopback rig.",
)
@click.option(
    "--sim",
    "sim_path",
    type=SIM,
    help="SIM.yaml to fly instead of the one that the rig names; needs --virtual.",
)
@click.option(
    "--virtual",
    is_flag=True,
    help="Fly in this process, on the simulated rig, in virtual time.",
)
@click.option(
    "--out",
    required=True,
    type=FOLDER,
    help="Folder that logs and reports are written into; it must not already contain logs.",
)
@click.option(
    "--if-gone",
    type=click.Choice(["go_on", "land"]),
    help="What the daemon does if this command is interrupted. Default: service.client_gone of "
    "the rig.",
)
@click.option(
    "--override",
    multiple=True,
    metavar="CHECK",
    help="Fly although this check before lift-off failed (`levid status` lists them): devices, "
    "amplifiers, recorder, disk, real_time, cpu, loop or motion. May be repeated; the log says so.",
)
@click.option(
    "--note",
    default="",
    metavar="NOTE",
    help="A line on this flight, for its logs and `levid list`.",
)
@full_option
def command(
    session: Path,
    rig_path: Path | None,
    sim_path: Path | None,
    virtual: bool,
    out: Path,
    if_gone: str | None,
    override: tuple[str, ...],
    note: str,
    full: bool,
) -> int:
    """Fly SESSION.yaml; write one log per step and a report of the flight to --out.

    Without --virtual the daemon that `levid run` started flies in real time. With --virtual this
    process flies the simulated rig as fast as the code runs. Prints the number of cycles, late
    cycles and lost rows, the path of the report, and the next command.

    \b
    Examples:
      levid excite white-noise-1khz --virtual --out out/first
      levid excite my-session.yaml --sim rig --virtual --out out/second
      levid excite beam --out out/beam --note "new rods, 21 degrees C"
      levid excite beam --out /var/lib/levid/today
    """
    from ..config.session import load_session

    config = load_session(session)
    refuse_used_folder(out)
    if virtual and override:
        raise click.UsageError("--override: a virtual flight is not checked before lift-off")
    if virtual:
        result = fly_here(config, session, rig_path, sim_path, out, note)
    elif sim_path is not None:
        raise click.UsageError(
            "--sim: expected --virtual too; without it the daemon flies the SIM.yaml of its rig"
        )
    else:
        result = _on_daemon(session, rig_path, out, if_gone, override, note)
    late = f", {result.late} late cycles" if result.late else ""
    lost = f", {result.lost} rows lost" if result.lost else ""
    records = f"{len(result.records)} record{'s' * (len(result.records) != 1)}"
    say(
        f"flew {result.cycles} cycles, {records}{late}{lost}, "
        f"logs in {result.logs[0].parent if result.logs else out}"
    )
    if result.coil_check:
        say(result.coil_check)
    return _after_landing(config, result, out, full)


def fly_here(
    config: SessionConfig,
    session: Path,
    rig_path: Path | None,
    sim_path: Path | None,
    out: Path,
    note: str = "",
) -> FlightResult:
    """Fly a session in this process in virtual time.

    Raises:
        ConfigError: a file is wrong, or the rig cannot fly the session.
        FlightFault: the flight ended in a fault; its logs are in `out`.
    """
    from ..api.flight import fly_session
    from ..daemon.control.faults import FlightFault

    with progress(f"flying {config.name}") as report:
        try:
            return fly_session(
                config, session.read_bytes(), str(session), rig_path, sim_path, out, report, note
            )
        except FlightFault:
            say(f"logs up to 0.5 s after the fault: {out}")
            raise


def refuse_used_folder(out: Path) -> None:
    """Raise ConfigError if `out` is not a folder or contains logs, which are never overwritten."""
    from ..api.output_folder import folder_without_logs

    # A folder of the service: the daemon writes there and checks it.
    with contextlib.suppress(PermissionError), naming_out():
        folder_without_logs(out)


def _text(path: Path) -> str:
    """Return the text of a YAML file, which may be in UTF-8 or UTF-16."""
    from ..config.base import ConfigError

    raw = path.read_bytes()
    wide = raw.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
    try:
        return raw.decode("utf-16" if wide else "utf-8-sig")
    except UnicodeDecodeError as error:
        raise ConfigError(f"{path}: expected text in UTF-8: {error}") from None


def _on_daemon(
    session: Path,
    rig_path: Path | None,
    out: Path,
    if_gone: str | None,
    override: tuple[str, ...],
    note: str,
) -> FlightResult:
    from ..config.rig import load_rig
    from ..daemon.api.socket_paths import socket_path
    from ..daemon.client import Client, NoDaemonError

    rig = load_rig(rig_path) if rig_path is not None else None
    # Includes the model, which the daemon compares too.
    rig_text = rig.model_dump_json() if rig is not None else None
    try:
        with Client(socket_path(rig)) as client, progress("flying on the daemon") as report:
            return client.excite(
                *(_text(session), out.resolve(), report, rig_text, if_gone, override, note),
                warn=lambda text: say(f"warning: {text}"),
            )
    except NoDaemonError as error:
        raise NoDaemonError(f"{error}, or fly in this process with --virtual") from None
    except KeyboardInterrupt:
        if if_gone != "land":
            say(
                "the flight goes on or lands, as service.client_gone of the rig says; "
                f"`{command_line('land', rig=rig_path)}` lands it"
            )
        raise


def _after_landing(config: SessionConfig, result: FlightResult, out: Path, full: bool) -> int:
    """Run the session's `then` commands or draw the flight; return the exit code."""
    from ..daemon.recording.post_processing import HandoverError, hand_over

    excited = any(step.record is not None and step.record.excite for step in config.steps)
    next_command = command_line("identify", logs=result.logs, out=out / "identification")
    if result.stopped:
        say(f"landed on request before the session's end; to use its logs: {next_command}")
        return 1
    if not os.access(out, os.W_OK):  # a folder of the service, where only the daemon may write
        say(f"no report: {out} may not be written to; to use the logs: {next_command}")
        return 0
    if config.then and result.records:
        failed = []
        for verb in config.then:
            try:
                hand_over(verb, result.logs, out / _REPORT_FOLDERS[verb])  # prints the report path
            except HandoverError as error:  # the other commands still run
                say(f"error: {error}")
                again = command_line(verb, logs=result.logs, out=out / _REPORT_FOLDERS[verb])
                say(f"to repeat it: {again}")
                failed.append(verb)
        return 1 if failed else 0
    pages = []

    def draw() -> None:
        from ..report.session.session_page import session_report

        with progress("drawing the flight") as report:
            report("", 0.5)
            pages.append(session_report(result.logs, out / "report", full=full))

    undrawn = report_or_error(draw)
    for page in pages:
        say(f"report: {page}")
    if excited:
        say(f"next: {next_command}")
    return exit_code_of_report(undrawn)
