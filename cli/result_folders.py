"""Folders that results go to, and how a command that names one is written for a shell."""

from __future__ import annotations

import os
import shlex
from collections.abc import Iterable, Sequence
from pathlib import Path

_FEW = 3
_TICK_S = 0.05


def writable_folder(out: Path, files: Iterable[str] = (), folders: Iterable[str] = ()) -> None:
    """See before a long work that its folder, and these in it, can be made and written to.

    Raises ConfigError.
    """
    from ..config.base import ConfigError

    if out.is_symlink() and not out.exists():
        raise ConfigError(f"--out {out}: expected a folder, found a link to nothing")
    there = out.absolute()
    while not there.exists():
        there = there.parent
    if not there.is_dir():
        found = "a file" if there == out.absolute() else f"the file {there}"
        raise ConfigError(f"--out {out}: expected a folder, found {found}")
    if not os.access(there, os.W_OK | os.X_OK):
        raise ConfigError(
            f"--out {out}: expected a folder, found that {there} may not be written to"
        )
    for name in files:
        if (out / name).is_dir():
            raise ConfigError(f"--out {out}: expected to write {name}, found a folder of that name")
    for name in folders:
        inner = out / name
        if inner.exists() and not (inner.is_dir() and os.access(inner, os.W_OK | os.X_OK)):
            raise ConfigError(f"--out {out}: expected {name} to be a folder that may be written to")


def older_results(out: Path, names: Iterable[str], began_s: float) -> list[Path]:
    """Return the results in a folder that were there before a work began, at that time of day."""
    # Times of files come from a clock that ticks: they may be a little before what time() says.
    paths = [out / name for name in names]
    return [p for p in paths if p.exists() and p.stat().st_mtime < began_s - _TICK_S]


def logs_in(folder: Path) -> str:
    """Return all logs of a folder as a shell takes them."""
    return f"{shlex.quote(str(folder))}/*.mcap"


def quoted(*paths: Path) -> str:
    """Return paths as a shell takes them."""
    return shlex.join(map(str, paths))


def same_logs(logs: Sequence[Path]) -> str:
    """Return these logs as a shell takes them: by name, or by folder where they are all of one."""
    if len(logs) <= _FEW:
        return quoted(*logs)
    words = []
    for folder in dict.fromkeys(log.parent for log in logs):
        own = [log for log in logs if log.parent == folder]
        words.append(logs_in(folder) if set(own) == set(folder.glob("*.mcap")) else quoted(*own))
    return " ".join(words)
