"""Where control sockets are, and whether a daemon listens there; what `levid stop` has to load."""

from __future__ import annotations

import os
import socket
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:  # it takes a second to load, and nobody may wait for that to stop a flight
    from ...config.rig import RigConfig

_SERVICE = Path("/run/levid/levid.sock")
_OTHERS_WRITE = 0o022


def own_socket(rig: RigConfig | None) -> Path:
    """Return where a daemon that is started here has its control socket."""
    if rig is not None and rig.socket:
        return Path(rig.socket)
    runtime = os.environ.get("RUNTIME_DIRECTORY") or os.environ.get("XDG_RUNTIME_DIR")
    if runtime:
        return Path(runtime) / "levid.sock"
    return Path("/tmp") / f"levid-{os.getuid()}" / "levid.sock"


def socket_path(rig: RigConfig | None) -> Path:
    """Return the control socket of the daemon that runs `rig`, or of the default one.

    That is this user's, unless nobody listens there, but a service of the machine's exists: what
    a daemon that was killed left behind is not asked.
    """
    path = own_socket(rig)
    named = rig is not None and rig.socket
    return _SERVICE if not named and _SERVICE.exists() and not listens(path) else path


def listens(path: Path) -> bool:
    """Return whether somebody listens at a Unix socket."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as probe:
        probe.settimeout(1.0)
        try:
            probe.connect(str(path))
        except (ConnectionRefusedError, FileNotFoundError):
            return False
        except OSError:  # so many ask it that nobody gets in
            return True
        return True


def require_own_folder(path: Path) -> None:
    """Raise PermissionError where others could put a socket of theirs in the place of this one.

    In /tmp anybody may have made the folder before.
    """
    folder = path.parent
    if folder.parent != Path("/tmp") or not folder.exists():
        return
    found = folder.lstat()
    if found.st_uid != os.getuid() or found.st_mode & _OTHERS_WRITE:
        raise PermissionError(
            0, f"expected {folder} to be this user's and to be written by nobody else"
        )
