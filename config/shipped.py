"""Locate the configuration files that levid ships, by path or by name."""

from __future__ import annotations

import difflib
from pathlib import Path

_FOLDER = Path(__file__).resolve().parent
_FOLDERS = {
    "rig": "rigs",
    "session": "sessions",
    "sim": "sims",
    "model": "models",
    "signals": "signals",
}
"""Folder of each kind of file, by the value of its key `levid`."""
KINDS = tuple(_FOLDERS)
TEMPLATE = {
    "rig": "loopback",
    "session": "white-noise-1khz",
    "sim": "nominal",
    "model": "rig",
    "signals": "silverbox",
}
"""Shipped file of each kind that a new one best starts from."""
_SIMILAR = 0.6
"""Least similarity of a suggested name, as difflib's default."""


def shipped(name: str) -> Path:
    """Return the path of a shipped file such as `rigs/loopback.yaml`; raises FileNotFoundError."""
    path = _FOLDER / name
    if not path.is_file():
        raise FileNotFoundError(f"levid ships no config/{name}")
    return path


def shipped_names(kind: str) -> tuple[str, ...]:
    """Return the names of the shipped files of one of KINDS, such as `loopback` for a rig."""
    return tuple(sorted(path.stem for path in (_FOLDER / _FOLDERS[kind]).glob("*.yaml")))


def shipped_file(name: str, *kinds: str) -> Path | None:
    """Return the path of the shipped file with this name, such as `loopback` or `rigs/loopback`.

    `kinds`: kinds to search; default: all. None if no file has the name, or files of several kinds.
    """
    found = _matches(name, kinds or KINDS)
    return found[0] if len(found) == 1 else None


def find_file(
    given: str | Path, *kinds: str, folder: Path | None = None, folders: bool = False
) -> Path:
    """Return the path of a configuration file that is given by its path or by a shipped name.

    A file that exists wins over a name, and with `folders` a folder too. A text that is neither is
    returned as a path: reading it fails, with the hint of `not_found`. `folder`: where relative
    paths begin; default: the current folder. `kinds`: as in `shipped_file`.
    """
    path = Path(given) if folder is None else folder / given
    try:
        exists = path.exists() and (folders or not path.is_dir())
    except (OSError, ValueError):  # an invalid file name
        return path
    return path if exists else shipped_file(str(given), *kinds) or path


def not_found(path: str | Path, *kinds: str) -> str:
    """Return a hint for a file that does not exist: shipped files with this or a similar name.

    The text begins with "; " and is empty if no shipped file has a similar name.
    """
    name = Path(path).name.removesuffix(".yaml")
    searched = kinds or KINDS
    same = _matches(name, searched)
    if len(same) > 1:
        return f"; levid ships {' and '.join(map(_qualified, same))}: give one of these names"
    if same:
        return f"; levid ships a {_kind(same[0])} with the name {name}"
    known = {name: None for kind in searched for name in shipped_names(kind)}
    near = difflib.get_close_matches(name, known, cutoff=_SIMILAR)
    if near:
        return f"; levid ships files with the similar names {', '.join(near)}"
    if len(searched) == 1 and Path(path).name == name:
        return f"; levid ships the {_FOLDERS[searched[0]]} {', '.join(known)}"
    return ""


def _matches(name: str, kinds: tuple[str, ...]) -> list[Path]:
    folder, _, stem = name.rpartition("/")
    return [
        _FOLDER / _FOLDERS[kind] / f"{stem}.yaml"
        for kind in kinds
        if folder in ("", _FOLDERS[kind]) and stem in shipped_names(kind)
    ]


def _qualified(path: Path) -> str:
    return f"{path.parent.name}/{path.stem}"


def _kind(path: Path) -> str:
    return next(kind for kind, folder in _FOLDERS.items() if folder == path.parent.name)
