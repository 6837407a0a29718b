"""Check output folders before long work, and claim them against other levid commands."""

from __future__ import annotations

import contextlib
import fcntl
import os
from collections.abc import Iterable, Iterator
from contextvars import ContextVar
from pathlib import Path

from ..config.base import ConfigError
from ..config.files.folders import make_folder

_CLAIMED: ContextVar[frozenset[Path]] = ContextVar("_CLAIMED", default=frozenset())


class OutputFolderError(ConfigError):
    """An output folder that cannot be written; the message begins with its path."""


@contextlib.contextmanager
def claimed_folder(
    out: Path, files: Iterable[str] = (), folders: Iterable[str] = ()
) -> Iterator[None]:
    """Create `out` and keep other levid commands from writing into it meanwhile.

    The lock is that of the folder itself, so nothing is left of it, and it ends with the process. A
    folder that this creates and that stays empty is removed. A folder may be claimed again inside
    the `with` body.

    Raises:
        OutputFolderError: the folder, or one of these files and folders in it, cannot be written,
            or another command writes into it.
    """
    writable_folder(out, files, folders)
    claimed = _CLAIMED.get()
    if out.resolve() in claimed:
        yield
        return
    created = [p for p in (out, *out.parents) if not p.exists()]
    make_folder(out)
    handle = os.open(out, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    token = _CLAIMED.set(claimed | {out.resolve()})
    try:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise OutputFolderError(
                f"{out}: another levid command is writing into this folder: wait for it, or "
                "give another folder"
            ) from None
        except OSError:
            pass  # a file system without locks, as some network shares are
        yield
    finally:
        _CLAIMED.reset(token)
        os.close(handle)
        with contextlib.suppress(OSError):  # not empty: the results are in it
            for folder in created:
                folder.rmdir()


def writable_folder(out: Path, files: Iterable[str] = (), folders: Iterable[str] = ()) -> None:
    """Check that `out`, and these files and folders in it, can be created and written.

    Call it before long work. It creates nothing.

    Raises:
        OutputFolderError: one of them cannot.
    """
    if out.is_symlink() and not out.exists():
        raise OutputFolderError(f"{out}: expected a folder, found a link to a missing path")
    existing = nearest_existing(out)
    if not existing.is_dir():
        found = "a file" if existing == out.absolute() else f"the file {existing}"
        raise OutputFolderError(f"{out}: expected a folder, found {found}")
    if not os.access(existing, os.W_OK | os.X_OK):
        raise OutputFolderError(
            f"{out}: expected a writable folder, but {existing} may not be written to"
        )
    for name in files:
        if (out / name).is_dir():
            raise OutputFolderError(f"{out}: expected to write {name}, found a folder of that name")
    for name in folders:
        inner = out / name
        if inner.exists() and not (inner.is_dir() and os.access(inner, os.W_OK | os.X_OK)):
            raise OutputFolderError(f"{out}: expected {name} to be a writable folder")


def nearest_existing(path: Path) -> Path:
    """Return the absolute path, or the nearest path above it that exists."""
    path = path.absolute()
    while not path.exists():
        path = path.parent
    return path


def folder_without_logs(out: Path) -> None:
    """Raise OutputFolderError if `out` is not a folder or has logs, which are never overwritten."""
    if out.exists() and not out.is_dir():
        raise OutputFolderError(f"{out}: expected a folder, found a file")
    logs = sorted(out.glob("*.mcap")) if out.is_dir() else []
    if logs:
        raise OutputFolderError(
            f"{out}: expected a folder without logs, found {len(logs)} "
            f"({logs[0].name}, ...); logs are never overwritten: name another folder"
        )
