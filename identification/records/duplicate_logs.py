"""Detect a log that is given twice, under one path or as a copy, so that it is used once."""

from __future__ import annotations

import hashlib
from pathlib import Path

import numpy as np

from ...log.reader import Log


class DuplicateCheck:
    """Remember the logs read so far: a copy would be held-out data for its own original."""

    def __init__(self) -> None:
        self._known: dict[object, Path] = {}

    def repeated_path(self, path: Path) -> str | None:
        """Return a remark if this path was given before, else None."""
        if path.resolve() in self._known:
            return f"{path}: given twice, used once"
        self._known[path.resolve()] = path
        return None

    def copy_of(self, path: Path, key: object) -> str | None:
        """Return a remark if the log of this `identity` is a copy of an earlier one, else None."""
        original = self._known.setdefault(key, path)
        return None if original == path else f"{path}: the same record as {original}, used once"


def identity(log: Log) -> object:
    """Return a key that copies of a log share: record, session and a hash of its rows."""
    rows = hashlib.sha256(np.ascontiguousarray(log.rows).view(np.uint8).data).digest()
    return log.metadata.get("name"), log.metadata.get("session"), rows
