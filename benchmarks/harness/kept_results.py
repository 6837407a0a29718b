"""What a long benchmark has measured so far, on disk: one that was stopped carries on from it."""

from __future__ import annotations

import hashlib
import json
import os
import platform
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

KEPT = Path(__file__).resolve().parents[2] / "build"
_WHOLE = {"whole": True}


class Kept:
    """The lines of a file, each a JSON object of one round; what a stop has cut off is dropped.

    A file that was marked whole is put aside: the next run begins anew.
    """

    def __init__(self, file: Path) -> None:
        self._file = file
        file.parent.mkdir(parents=True, exist_ok=True)
        self.lines, cut = _lines(file)
        if _WHOLE in self.lines:
            at = time.strftime("%Y%m%d-%H%M%S", time.localtime(file.stat().st_mtime))
            file.replace(file.with_suffix(f".{at}.jsonl"))
            self.lines = []
        if not self.lines:
            self.add({"host": host(), "begun": _now()})
        elif cut:
            new = file.with_suffix(".new")
            new.write_text("".join(json.dumps(line) + "\n" for line in self.lines))
            new.replace(file)  # at no time is less on disk than was

    def add(self, line: dict[str, Any]) -> None:
        """Append a line; it is in the file on return."""
        self.lines.append(line)
        with self._file.open("a") as out:
            out.write(json.dumps(line) + "\n")

    def of(self, section: str) -> list[dict[str, Any]]:
        """Return the lines of a section."""
        return [line for line in self.lines if line.get("section") == section]

    def close(self) -> None:
        """Mark the file as whole."""
        self.add(dict(_WHOLE))


class Parts:
    """Parts of one run by their keys, each kept once it is measured.

    The file's name should hold the version of the code, and whatever else decides what comes.
    """

    def __init__(self, file: Path) -> None:
        self._kept = Kept(file)
        self._parts = {line["key"]: line["value"] for line in self._kept.lines if "key" in line}
        if self._parts:
            print(f"carries on behind {len(self._parts)} parts of {file}", file=sys.stderr)

    def __contains__(self, key: str) -> bool:
        return key in self._parts

    def get(self, key: str) -> Any:
        """Return a part that is there, as plain data."""
        return self._parts[key]

    def keep(self, key: str, value: Any) -> None:
        """Add a part: plain data that JSON knows."""
        self._kept.add({"key": key, "value": value})
        self._parts[key] = json.loads(json.dumps(value))  # as a run that carries on reads it

    def part(self, key: str, measure: Callable[[], Any]) -> Any:
        """Return what `measure` gave, now or in a run before."""
        if key not in self:
            self.keep(key, measure())
        return self.get(key)

    def finish(self) -> None:
        """Mark the run as whole: the next one begins anew."""
        self._kept.close()


def host() -> dict[str, Any]:
    """Return what a timing depends on beside the code."""
    info = Path("/proc/cpuinfo").read_text() if Path("/proc/cpuinfo").exists() else ""
    models = [line.partition(":")[2].strip() for line in info.splitlines() if "model name" in line]
    return {
        "node": platform.node(),
        "kernel": platform.release(),
        "cpus": os.cpu_count(),
        "cpu": models[0] if models else platform.machine(),
    }


def host_digest() -> str:
    """Return a short name of this host, for the names of files."""
    return hashlib.sha256(json.dumps(host(), sort_keys=True).encode()).hexdigest()[:6]


def _now() -> str:
    return time.strftime("%Y-%m-%dT%H:%M:%S%z")


def _lines(file: Path) -> tuple[list[dict[str, Any]], bool]:
    """Return what a file holds, and whether there is more behind that, cut off."""
    found: list[dict[str, Any]] = []
    text = file.read_text() if file.exists() else ""
    for line in text.splitlines():
        try:
            found.append(json.loads(line))
        except ValueError:
            return found, True
    return found, not text.endswith("\n") and bool(text)
