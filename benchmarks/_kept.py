"""What a long benchmark has measured so far, on disk: a run that was stopped carries on from it."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any


class Kept:
    """Parts of one run by their keys, appended to a file of JSON lines as they come.

    The file's name should hold the version of the code, and whatever else decides what comes.
    """

    def __init__(self, file: Path) -> None:
        self._file = file
        self._parts: dict[str, Any] = {}
        for line in file.read_text().splitlines() if file.exists() else []:
            try:
                part = json.loads(line)
            except json.JSONDecodeError:  # empty, or its writer was killed in the middle of it
                continue
            self._parts[part["key"]] = part["value"]
        if self._parts:
            print(f"carries on behind {len(self._parts)} parts of {file}", file=sys.stderr)

    def __contains__(self, key: str) -> bool:
        return key in self._parts

    def get(self, key: str) -> Any:
        """Return a part that is there, as plain data."""
        return self._parts[key]

    def keep(self, key: str, value: Any) -> None:
        """Add a part: plain data that JSON knows."""
        self._file.parent.mkdir(parents=True, exist_ok=True)
        line = json.dumps({"key": key, "value": value})
        with self._file.open("a") as out:  # on a line of its own, whatever ended before it
            out.write(f"\n{line}\n")
        self._parts[key] = json.loads(line)["value"]  # as a run that carries on reads it

    def part(self, key: str, measure: Callable[[], Any]) -> Any:
        """Return what `measure` gave, now or in a run before."""
        if key not in self:
            self.keep(key, measure())
        return self.get(key)

    def finish(self) -> None:
        """Put the file aside: a whole run is not carried on."""
        if self._file.exists():
            self._file.replace(self._file.with_suffix(".before.jsonl"))
