"""Find the folders of this user; HOME and XDG_* may name anything, or nothing."""

from __future__ import annotations

import os
from pathlib import Path


def absolute_folder(name: str | None) -> Path | None:
    """Return a path if it is absolute, else None: it would depend on the working directory."""
    path = Path(name or "")
    return path if path.is_absolute() else None


def home() -> Path | None:
    """Return this user's home folder; None if there is none that exists.

    HOME counts if it is an absolute path of a folder, else the entry of the user.
    """
    named = absolute_folder(os.environ.get("HOME"))
    return named if named is not None and named.is_dir() else account_home()


def account_home() -> Path | None:
    """Return the home folder in the entry of this user; None if there is none that exists."""
    import pwd

    try:
        entry = absolute_folder(pwd.getpwuid(os.getuid()).pw_dir)
    except KeyError:  # a container may run as any number
        return None
    return entry if entry is not None and entry.is_dir() else None


def xdg_folder(variable: str, below_home: str) -> Path | None:
    """Return a base folder by its XDG variable, else below the home folder, else None.

    The variable counts if it is an absolute path, as its specification says.
    """
    named = absolute_folder(os.environ.get(variable))
    if named is not None:
        return named
    found = home()
    return found / below_home if found is not None else None


def temporary_folder() -> Path:
    """Return this user's folder in /tmp; another user may have made it: check its owner."""
    return Path("/tmp") / f"levid-{os.getuid()}"
