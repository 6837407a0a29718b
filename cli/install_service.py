"""`levid install-service`: the files that make the daemon a service of systemd."""

from __future__ import annotations

import sysconfig
from pathlib import Path

import click

from .progress import say


@click.command("install-service")
@click.argument("rig", type=click.Path(path_type=Path))
@click.option(
    "--root",
    type=click.Path(path_type=Path),
    default=Path("/"),
    help="Write below this folder, as for an image; / unless given.",
)
@click.option("--dry-run", is_flag=True, help="Print the files, write nothing.")
@click.option("--force", is_flag=True, help="Replace files that were changed by hand, too.")
def command(rig: Path, root: Path, dry_run: bool, force: bool) -> int:
    """Write what systemd, networkd and udev need to run the daemon on RIG.yaml.

    The unit levid.service, the user levid, bitrates and restart of its CAN interfaces, and the
    right to its serial adapters. Nothing is started: it says what comes next.

    \b
    Examples:
      levid install-service /etc/levid/rig.yaml --dry-run
      sudo levid install-service /etc/levid/rig.yaml
    """
    from ..config.rig import load_rig
    from ..daemon.service.service_files import (
        NETWORK,
        hindrances,
        left_over,
        preview,
        service_files,
        write,
    )

    config, rig_file = load_rig(rig), rig.resolve()
    program = Path(sysconfig.get_path("scripts")) / "levid"
    files = service_files(config, rig_file, program)
    if dry_run:
        for path, what in preview(files, root).items():
            click.echo(f"# {root / path}: {what}\n{files[path]}")
    else:
        for path, what in write(files, root, force).items():
            say(f"{root / path}: {what}")
    for old in left_over(files, root):
        say(f"warning: {old} is of a rig before this one and still holds: remove it")
    for hindrance in hindrances(config, rig_file, program):
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
            say("then plug CAN adapters in anew, or reboot: queue and name come with that")
        say("who may ask it: usermod --append --groups levid NAME; then: levid status")
    return 0
