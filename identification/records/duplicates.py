"""Logs that are given more than once, by name or as a copy, and are used once."""

from __future__ import annotations

import hashlib
from pathlib import Path

import numpy as np

from ...log.reader import Log


class Once:
    """What was read already: a copy among other records would be held out against itself."""

    def __init__(self) -> None:
        self._seen: dict[object, Path] = {}

    def again(self, path: Path) -> str | None:
        """Return in words that this path was given before; else None."""
        if path.resolve() in self._seen:
            return f"{path}: given twice, used once"
        self._seen[path.resolve()] = path
        return None

    def copied(self, path: Path, log: Log) -> str | None:
        """Return in words of which log this one is a copy; None if of none."""
        same = self._seen.setdefault(_identity(log), path)
        return None if same == path else f"{path}: the same record as {same}, used once"


def _identity(log: Log) -> object:
    """Return what two copies of one log share: record, session and rows, cycle and all."""
    rows = hashlib.sha256(np.ascontiguousarray(log.rows).view(np.uint8).data).digest()
    return log.metadata.get("name"), log.metadata.get("session"), rows
