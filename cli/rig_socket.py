"""The option --rig of the commands that connect to the daemon, and the socket that it names."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path

import click

from .path_types import RIG

rig_option = click.option(
    "--rig",
    "rig_path",
    type=RIG,
    help="RIG.yaml that names the daemon's socket. Default: the default socket.",
)


def socket_of(rig_path: Path | None) -> Path:
    """Return the control socket of a rig's daemon, or of the default one; raises ConfigError."""
    return socket_finder(rig_path)()


def socket_finder(rig_path: Path | None) -> Callable[[], Path]:
    """Return a fast function that finds this socket anew; reads the rig now, raises ConfigError."""
    from ..daemon.api.socket_paths import socket_path

    rig = None
    if rig_path:
        from ..config.rig import load_rig  # takes 1 s: `levid stop` without --rig must not wait

        rig = load_rig(rig_path)
    return partial(socket_path, rig)
