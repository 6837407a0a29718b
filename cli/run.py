"""`levid run`: run the daemon in real time."""

from __future__ import annotations

import signal
from pathlib import Path

import click

from .path_types import RIG

EXIT_CONFIG = 78
"""Exit code for a wrong RIG.yaml (EX_CONFIG of sysexits.h); systemd then does not restart it."""


@click.command("run")
@click.argument("rig", type=RIG)
def command(rig: Path) -> int:
    """Run the daemon on RIG.yaml in real time.

    Coils have zero force until a session flies (`levid excite`, `levid levitate`). Prints rig, rate
    and socket, then the journal. Ctrl-C or SIGTERM lands the platform and ends the daemon. Exit
    code 78 if RIG.yaml is wrong.

    \b
    Examples:
      levid run loopback
      levid excite beam --out out/beam     # in another terminal
      levid status
    """
    from ..config.base import ConfigError
    from ..config.rig import load_rig
    from ..daemon.api.socket_paths import listens, own_socket

    try:
        config = load_rig(rig)
    except ConfigError as error:
        click.echo(f"error: {error}", err=True)
        return EXIT_CONFIG
    path = own_socket(config)
    if listens(path):  # asked before the imports of a daemon, which take seconds
        click.echo(f"error: {path}: another daemon already uses this socket", err=True)
        return 1

    from ..daemon.host.real_time_scheduling import avoid_cpus
    from ..daemon.service.journal import Journal
    from ..daemon.supervision.supervisor import Supervisor

    journal = Journal()
    log = journal.log
    try:
        avoid_cpus(config.realtime.cpus)
        supervisor = Supervisor(config, rig, path, log)
    except ConfigError as error:
        journal.close()
        click.echo(f"error: {error}", err=True)
        return EXIT_CONFIG
    journal.fields = supervisor.journal_fields
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: supervisor.stop())
    signal.signal(signal.SIGHUP, lambda *_: supervisor.reload())
    try:
        supervisor.run(
            lambda: log(f"{config.name} at {config.rate_hz:g} Hz, socket {path}; Ctrl-C lands")
        )
        log("stopped, zero force commanded")
    finally:
        journal.close()
    return 0
