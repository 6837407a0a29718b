"""Open a Unix socket at a path, without replacing the socket of another daemon."""

from __future__ import annotations

import contextlib
import fcntl
import os
import socket
import time
from collections.abc import Iterator
from pathlib import Path

from ...config.files.folders import make_folder
from .socket_paths import listens, require_own_folder

WAITING_CLIENTS = 128
_LOCK_S = 0.5
"""Longest wait for another daemon that opens its socket in the same folder; it takes no time."""
_POLL_S = 0.01


class ServerError(Exception):
    """Report that the control socket cannot be opened."""


class UnixListener:
    """Open and close a listening socket at `path`; never remove the socket of another daemon."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._inode: tuple[int, int] | None = None

    @property
    def in_place(self) -> bool:
        """Whether the path still leads to this socket. Session folders are removed at log-out."""
        return self._inode is not None and _inode_of(self._path) == self._inode

    def open(self, mode: int) -> socket.socket:
        """Return a socket that listens at the path, with this file mode; raises ServerError."""
        with contextlib.suppress(FileNotFoundError):  # the folder was removed in between
            return self._open(mode)
        try:
            return self._open(mode)
        except FileNotFoundError as error:
            raise ServerError(f"{self._path}: cannot open the control socket: {error}") from None

    def _open(self, mode: int) -> socket.socket:
        """Return what `open` does; raises FileNotFoundError if the folder is removed meanwhile."""
        path = self._path
        listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        try:
            make_folder(path.parent, 0o750)
            require_own_folder(path)
            with _folder_lock(path.parent):
                self._remove_abandoned()
                listener.bind(str(path))
                self._inode = _inode_of(path)
                self.set_mode(mode)
                listener.listen(WAITING_CLIENTS)
        except FileNotFoundError:
            listener.close()
            raise
        except OSError as error:
            listener.close()
            raise ServerError(f"{path}: cannot open the control socket: {error}") from None
        except BaseException:
            listener.close()
            raise
        listener.setblocking(False)
        return listener

    def set_mode(self, mode: int) -> None:
        """Set the mode of the socket, and of no file to which somebody links its path meanwhile."""
        with contextlib.suppress(OSError):
            handle = os.open(self._path, os.O_PATH | os.O_NOFOLLOW | os.O_CLOEXEC)
            try:
                status = os.fstat(handle)
                if (status.st_dev, status.st_ino) == self._inode:
                    Path(f"/proc/self/fd/{handle}").chmod(mode)
            finally:
                os.close(handle)

    def close(self) -> None:
        """Remove the path unless it is another socket's by now; does not close the socket."""
        if self.in_place:
            self._path.unlink(missing_ok=True)

    def _remove_abandoned(self) -> None:
        """Remove the socket of a daemon that was killed."""
        path = self._path
        if not path.exists():
            return
        if not path.is_socket():
            raise ServerError(f"{path}: expected a socket or no file, found another kind of file")
        if listens(path):
            raise ServerError(f"{path}: another daemon already uses this socket")
        path.unlink()


def _inode_of(path: Path) -> tuple[int, int] | None:
    try:
        status = path.lstat()
    except OSError:
        return None
    return status.st_dev, status.st_ino


@contextlib.contextmanager
def _folder_lock(folder: Path) -> Iterator[None]:
    """Lock a folder, so that of two daemons that start at once the second detects the first.

    Otherwise each could take the other's socket for an abandoned one. A process that holds the lock
    longer than _LOCK_S does not prevent the start.
    """
    try:
        handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    except OSError:  # the folder may be writable but not readable
        yield
        return
    try:
        deadline_s = time.monotonic() + _LOCK_S
        while time.monotonic() < deadline_s:
            try:
                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError:
                time.sleep(_POLL_S)
            else:
                break
        yield
    finally:
        os.close(handle)
