"""`levid excite`: fly a session, here in virtual time or on the running daemon."""

from __future__ import annotations

from pathlib import Path

import click

from ..config.base import ConfigError
from ..config.rig import RigConfig, load_rig
from ..config.session import load_session
from ..config.shipped import shipped
from ..daemon.flight import FlightResult
from ..daemon.handover import identify_in_own_process
from ..daemon.virtual import fly_virtually
from ..report.session import session_report
from .progress import console, progress


@click.command("excite")
@click.argument("session", type=click.Path(path_type=Path))
@click.option(
    "--rig",
    "rig_path",
    type=click.Path(path_type=Path),
    help="RIG.yaml; the shipped loopback rig unless given.",
)
@click.option(
    "--sim",
    "sim_path",
    type=click.Path(path_type=Path),
    help="SIM.yaml to fly instead of the one the rig names (with --virtual).",
)
@click.option(
    "--virtual",
    is_flag=True,
    help="Fly in this process, on the loopback simulator, in virtual time.",
)
@click.option(
    "--out",
    required=True,
    type=click.Path(path_type=Path),
    help="Folder for the logs, new or empty.",
)
def command(
    session: Path, rig_path: Path | None, sim_path: Path | None, virtual: bool, out: Path
) -> int:
    """Fly SESSION.yaml and write one log a step into --out.

    With --virtual it flies here, as fast as the code runs; without it, the daemon that `levid run`
    started flies, in real time.

    \b
    Examples:
      levid excite config/sessions/white-noise-1khz.yaml --virtual --out out/first
      levid excite my-session.yaml --sim config/sims/rig.yaml --virtual --out out/second
      levid excite config/sessions/beam.yaml --out /var/lib/levid/today
    """
    config = load_session(session)
    refuse_used_folder(out)
    if not virtual:
        if sim_path is not None:
            raise click.UsageError(
                "--sim needs --virtual; the daemon's rig names its own simulator"
            )
        result = _on_daemon(session, rig_path, out)
    else:
        rig_file = rig_path or shipped("rigs/loopback.yaml")
        rig = with_sim(load_rig(rig_file), sim_path)
        with progress(f"flying {config.name}") as report:
            result = fly_virtually(
                rig,
                rig_file,
                config,
                session.read_bytes(),
                out,
                lambda step, done, total: report(step, done / total),
            )
    console.print(
        f"flew {result.cycles} cycles, {len(result.records)} records, logs in {out}"
        f"{f', {result.late} late cycles' if result.late else ''}"
    )
    if "identify" in config.then and result.records:
        report_path = identify_in_own_process(result.records, out / "identification")
        console.print(f"report: {report_path}")
        return 0
    with progress("drawing the flight") as report:
        report("", 0.5)
        console.print(f"report: {session_report(result.logs, out / 'report')}")
    if result.records:
        console.print(f"next: levid identify {out}/*.mcap --out {out}/identification")
    return 0


def refuse_used_folder(out: Path) -> None:
    """Raise ConfigError where `out` is no folder or holds logs: none is ever overwritten."""
    if out.exists() and not out.is_dir():
        raise ConfigError(f"--out {out}: expected a folder, found a file")
    logs = sorted(out.glob("*.mcap")) if out.is_dir() else []
    if logs:
        raise ConfigError(
            f"--out {out}: expected a new folder or one without logs, found {len(logs)} logs "
            f"({logs[0].name}, ...); logs are never overwritten"
        )


def with_sim(rig: RigConfig, sim_path: Path | None) -> RigConfig:
    """Return the rig with another simulator."""
    return rig if sim_path is None else rig.model_copy(update={"sim": str(sim_path.resolve())})


def _on_daemon(session: Path, rig_path: Path | None, out: Path) -> FlightResult:
    from ..daemon.client import Client, socket_path

    rig = load_rig(rig_path) if rig_path is not None else None
    with Client(socket_path(rig)) as client, progress("flying on the daemon") as report:
        return client.excite(session.read_text(), out.resolve(), report)
