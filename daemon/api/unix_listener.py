"""The door of the control socket: a path where it listens, for as long as the daemon runs."""

from __future__ import annotations

import contextlib
import fcntl
import os
import socket
import time
from collections.abc import Iterator
from pathlib import Path

from .socket_paths import listens, require_own_folder

WAITING_CLIENTS = 128
_ALONE_S = 0.5
"""How long another daemon may take to open its own door in the same folder; it takes no time."""
_POLL_S = 0.01


class ServerError(Exception):
    """A control socket that cannot be opened."""


class Door:
    """Opens at a path, never in the place of another's, and takes away nothing but itself."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._place: tuple[int, int] | None = None

    @property
    def in_place(self) -> bool:
        """Whether clients still find it. Folders of a user's session go when he logs out."""
        return self._place is not None and _place_of(self._path) == self._place

    def open(self, mode: int) -> socket.socket:
        """Return a socket that listens there from now on; raises ServerError."""
        path = self._path
        door = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        try:
            path.parent.mkdir(parents=True, exist_ok=True, mode=0o750)
            require_own_folder(path)
            with _alone_in(path.parent):
                self._make_room()
                door.bind(str(path))
                path.chmod(mode)
                door.listen(WAITING_CLIENTS)
                self._place = _place_of(path)
        except OSError as error:
            door.close()
            raise ServerError(f"{path}: cannot open the control socket: {error}") from None
        except BaseException:
            door.close()
            raise
        door.setblocking(False)
        return door

    def close(self) -> None:
        """Take the path away, unless somebody else has it by now; the socket is its owner's."""
        if self.in_place:
            self._path.unlink(missing_ok=True)

    def _make_room(self) -> None:
        """Take away what a daemon that was killed left behind."""
        path = self._path
        if not path.exists():
            return
        if not path.is_socket():
            raise ServerError(f"{path}: expected a socket or nothing, found a file")
        if listens(path):
            raise ServerError(f"{path}: another daemon answers here already")
        path.unlink()


def _place_of(path: Path) -> tuple[int, int] | None:
    try:
        found = path.lstat()
    except OSError:
        return None
    return found.st_dev, found.st_ino


@contextlib.contextmanager
def _alone_in(folder: Path) -> Iterator[None]:
    """Have a folder for oneself: of two daemons that start at once the second finds the first.

    Else each would take the other's socket for one that was left behind. Whoever holds the folder
    for longer, for reasons of his own, keeps nobody from starting.
    """
    try:
        handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    except OSError:  # it may be written to and not be read
        yield
        return
    try:
        give_up_s = time.monotonic() + _ALONE_S
        while time.monotonic() < give_up_s:
            try:
                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError:
                time.sleep(_POLL_S)
            else:
                break
        yield
    finally:
        os.close(handle)
