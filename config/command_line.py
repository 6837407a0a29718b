"""Write commands of levid that run in a shell as they are printed."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path, PurePath

from .escaping import shell_word

_MOST_NAMED = 3
"""Logs that a printed command names one by one."""


def command_line(
    verb: str, *paths: Path | str, logs: Sequence[Path] = (), **options: object
) -> str:
    """Return the command with its arguments quoted for a shell.

    `logs` follow `paths`; all logs of a folder become one pattern. An option that is None or False
    is left out, one that is True has no value, and a tuple several; `_` in its name becomes `-`.
    """
    words = ["levid", verb, *(_word(path) for path in paths)]
    if logs:
        words.append(log_words(logs))
    for name, value in options.items():
        if value is None or value is False:
            continue
        words.append(f"--{name.replace('_', '-')}")
        if isinstance(value, tuple):
            words += [shell_word(str(part)) for part in value]
        elif value is not True:
            words.append(_word(value) if isinstance(value, Path) else shell_word(str(value)))
    return " ".join(words)


def quoted(*paths: Path) -> str:
    """Return paths quoted for a shell; none of them looks like an option."""
    return " ".join(map(_word, paths))


def logs_in(folder: Path) -> str:
    """Return the shell pattern of all logs in a folder."""
    return f"{_word(folder)}/*.mcap"


def log_words(logs: Sequence[Path]) -> str:
    """Return logs quoted for a shell; all logs of a folder become one pattern."""
    if len(logs) <= _MOST_NAMED:
        return quoted(*logs)
    words = []
    for folder in dict.fromkeys(log.parent for log in logs):
        own = [log for log in logs if log.parent == folder]
        words.append(logs_in(folder) if set(own) == set(folder.glob("*.mcap")) else quoted(*own))
    return " ".join(words)


def unused(folder: Path) -> Path:
    """Return the folder, or the first of folder-2, folder-3, ... that does not exist."""
    number, free = 1, folder
    while free.exists():
        number += 1
        free = folder.with_name(f"{folder.name}-{number}")
    return free


def _word(path: Path | str) -> str:
    return shell_word(PurePath(path))
