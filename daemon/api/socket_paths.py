"""Find the control socket. `levid stop` loads this module: it imports nothing slow."""

from __future__ import annotations

import os
import socket
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:  # loading it takes a second, which would delay `levid stop`
    from ...config.rig import RigConfig

_SERVICE = Path("/run/levid/levid.sock")
_OTHERS_WRITE = 0o022


def own_socket(rig: RigConfig | None) -> Path:
    """Return the control socket path of a daemon that this user starts."""
    if rig is not None and rig.socket:
        return Path(rig.socket)
    runtime = os.environ.get("RUNTIME_DIRECTORY") or os.environ.get("XDG_RUNTIME_DIR")
    if runtime and Path(runtime).is_absolute():  # the specification says to ignore others
        return Path(runtime) / "levid.sock"
    return Path("/tmp") / f"levid-{os.getuid()}" / "levid.sock"


def socket_path(rig: RigConfig | None) -> Path:
    """Return the control socket path of the daemon that runs `rig`, or of the default one.

    This user's socket comes first. If no daemon listens there (a killed daemon may leave its socket
    behind), the socket of the system service is returned if it exists.
    """
    path = own_socket(rig)
    named = rig is not None and rig.socket
    return _SERVICE if not named and _SERVICE.exists() and not listens(path) else path


def listens(path: Path) -> bool:
    """Return whether a process listens at a Unix socket."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as probe:
        probe.settimeout(1.0)
        try:
            probe.connect(str(path))
        except (ConnectionRefusedError, FileNotFoundError):
            return False
        except OSError:  # its queue is full
            return True
        return True


def require_own_folder(path: Path) -> None:
    """Raise PermissionError if other users could replace this socket.

    In /tmp another user may have created the folder before.
    """
    folder = path.parent
    if folder.parent != Path("/tmp") or not folder.exists():
        return
    found = folder.lstat()
    if found.st_uid != os.getuid() or found.st_mode & _OTHERS_WRITE:
        raise PermissionError(
            0, f"{folder}: expected a folder that only this user owns and may write to; remove it"
        )
