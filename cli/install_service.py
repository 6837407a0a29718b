"""`levid install-service`: write the systemd, networkd and udev files of the daemon."""

from __future__ import annotations

import sysconfig
from pathlib import Path

import click

from .path_types import FOLDER, RIG
from .progress import say


@click.command("install-service")
@click.argument("rig", type=RIG)
@click.option(
    "--root",
    type=FOLDER,
    default=Path("/"),
    help="Write all files below this folder instead of /, for example into a mounted disk image.",
)
@click.option("--dry-run", is_flag=True, help="Print the files; write nothing.")
@click.option("--force", is_flag=True, help="Also replace files that were edited by hand.")
def command(rig: Path, root: Path, dry_run: bool, force: bool) -> int:
    """Install the daemon on RIG.yaml as a systemd service.

    Writes the unit levid.service, the user levid, bitrates and restart of the CAN interfaces, and
    access rights to the serial adapters. Starts nothing; prints the commands to run next.

    \b
    Examples:
      levid install-service /etc/levid/rig.yaml --dry-run
      sudo levid install-service /etc/levid/rig.yaml
    """
    from ..config.rig import load_rig, model_path
    from ..daemon.service.service_files import (
        NETWORK,
        left_over,
        preview,
        service_files,
        service_warnings,
        write,
    )

    config, rig_file = load_rig(rig), rig.resolve()
    program = Path(sysconfig.get_path("scripts")) / "levid"
    model_file = model_path(rig_file)
    files = service_files(config, rig_file, program, model_file)
    if dry_run:
        for path, change in preview(files, root).items():
            click.echo(f"# {root / path}: {change}\n{files[path]}")
    else:
        for path, change in write(files, root, force).items():
            say(f"{root / path}: {change}")
    for old in left_over(files, root):
        say(f"warning: {old} is from an earlier rig and still takes effect: remove it")
    for hindrance in service_warnings(config, rig_file, program, model_file):
        say(f"warning: {hindrance}")
    if not dry_run:
        networked = any(path.startswith(NETWORK) for path in files)
        reload = "systemctl enable --now systemd-networkd && networkctl reload && "
        say(
            "next: systemd-sysusers && udevadm control --reload && udevadm trigger && "
            f"{reload if networked else ''}"
            "systemctl daemon-reload && systemctl enable --now levid"
        )
        if any(path.endswith(".link") for path in files):
            say("then reconnect the CAN adapters or reboot, which sets queue length and name")
        say("to let user NAME control the daemon: usermod --append --groups levid NAME")
        say("to check: levid status")
    return 0
