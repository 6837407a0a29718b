"""Check and claim output folders before long work, and quote paths for printed shell commands."""

from __future__ import annotations

import contextlib
import fcntl
import os
import shlex
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

_MOST_NAMED = 3  # logs that a printed command names one by one
_FILE_TIME_RESOLUTION_S = 0.05


@contextlib.contextmanager
def claimed_folder(
    out: Path, files: Iterable[str] = (), folders: Iterable[str] = ()
) -> Iterator[None]:
    """Create `out` and keep other levid commands from writing into it meanwhile.

    The lock is that of the folder itself, so nothing is left of it, and it ends with the process. A
    folder that this creates and that stays empty is removed.

    Raises:
        ConfigError: the folder, or one of these files and folders in it, cannot be written, or
            another command writes into it.
    """
    from ..config.base import ConfigError

    writable_folder(out, files, folders)
    created = [p for p in (out, *out.parents) if not p.exists()]
    out.mkdir(parents=True, exist_ok=True)
    handle = os.open(out, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise ConfigError(
                f"--out {out}: another levid command is writing into this folder: wait for it, or "
                "give another folder"
            ) from None
        except OSError:
            pass  # a file system without locks, as some network shares are
        yield
    finally:
        os.close(handle)
        with contextlib.suppress(OSError):  # not empty: the results are in it
            for folder in created:
                folder.rmdir()


def writable_folder(out: Path, files: Iterable[str] = (), folders: Iterable[str] = ()) -> None:
    """Check that `out`, and these files and folders in it, can be created and written.

    Call it before long work. It creates nothing.

    Raises:
        ConfigError: one of them cannot.
    """
    from ..config.base import ConfigError

    if out.is_symlink() and not out.exists():
        raise ConfigError(f"--out {out}: expected a folder, found a link to a missing path")
    existing = out.absolute()
    while not existing.exists():
        existing = existing.parent
    if not existing.is_dir():
        found = "a file" if existing == out.absolute() else f"the file {existing}"
        raise ConfigError(f"--out {out}: expected a folder, found {found}")
    if not os.access(existing, os.W_OK | os.X_OK):
        raise ConfigError(
            f"--out {out}: expected a writable folder, but {existing} may not be written to"
        )
    for name in files:
        if (out / name).is_dir():
            raise ConfigError(f"--out {out}: expected to write {name}, found a folder of that name")
    for name in folders:
        inner = out / name
        if inner.exists() and not (inner.is_dir() and os.access(inner, os.W_OK | os.X_OK)):
            raise ConfigError(f"--out {out}: expected {name} to be a writable folder")


def older_results(out: Path, names: Iterable[str], began_s: float) -> list[Path]:
    """Return the files in `out` that were last written before `began_s`, in s as time.time()."""
    # The kernel's clock for file times may be one tick behind time.time().
    paths = [out / name for name in names]
    return [
        p for p in paths if p.exists() and p.stat().st_mtime < began_s - _FILE_TIME_RESOLUTION_S
    ]


def logs_in(folder: Path) -> str:
    """Return the shell pattern of all logs in a folder."""
    return f"{shlex.quote(str(folder))}/*.mcap"


def quoted(*paths: Path) -> str:
    """Return paths quoted for a shell."""
    return shlex.join(map(str, paths))


def same_logs(logs: Sequence[Path]) -> str:
    """Return logs quoted for a shell; all logs of a folder become one pattern."""
    if len(logs) <= _MOST_NAMED:
        return quoted(*logs)
    words = []
    for folder in dict.fromkeys(log.parent for log in logs):
        own = [log for log in logs if log.parent == folder]
        words.append(logs_in(folder) if set(own) == set(folder.glob("*.mcap")) else quoted(*own))
    return " ".join(words)
