"""Keep a catalogue of the flights and results below a folder, updated incrementally.

`catalogue.jsonl` in the folder has one line of JSON a flight. It is one file, not one a flight: a
query opens one file instead of thousands. A line is computed again only if a log of its flight was
written, added or removed, or a result was. The catalogue can be deleted at any time.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, fields, replace
from datetime import datetime
from pathlib import Path
from typing import Any

from ...config.files.atomic_write import write_file
from ...config.files.reading import parse_json
from .results import RESULT, ResultSummary, read_result
from .run_summary import RunSummary, state_of, summarise_run

CATALOGUE = "catalogue.jsonl"
_SKIPPED = ("figures", "report", "__pycache__")
"""Folders that hold neither logs nor results."""


@dataclass(frozen=True)
class Run:
    """A flight and its results, the newest first."""

    summary: RunSummary
    results: tuple[ResultSummary, ...]


def update_catalogue(
    folder: Path,
    progress: Callable[[str, float], None] | None = None,
    problem: Callable[[OSError], None] | None = None,
) -> tuple[Run, ...]:
    """Return the flights below a folder, newest first, and bring its catalogue.jsonl up to date.

    Paths are relative to the folder. A folder that may not be written to is read all the same. A
    result belongs to the flight in whose folder it is, else to the flight of its first log.
    problem: called for each folder that cannot be read; the others are listed all the same.
    """
    report = progress or (lambda _what, _share: None)
    found = list(_folders(folder, problem))
    known = _known(folder / CATALOGUE)
    summaries = []
    with_logs = [(name, logs) for name, logs, _ in found if logs]
    for number, (name, logs) in enumerate(with_logs):
        report(name, number / len(with_logs))
        old = known.get(name)
        if old is not None and old.state == state_of(logs):
            summaries.append(old)
        else:
            summaries.append(summarise_run(name, logs))
    results = _results(folder, [name for name, _, result in found if result], summaries)
    runs = [
        Run(summary, tuple(sorted(results[summary.folder], key=lambda r: r.written, reverse=True)))
        for summary in summaries
    ]
    runs.sort(key=lambda run: run.summary.flown, reverse=True)
    _save(folder / CATALOGUE, runs)
    return tuple(runs)


def plain_run(run: Run) -> dict[str, object]:
    """Return a flight as JSON data: one line of the catalogue."""
    newest = {command: _newest(run, command) for command in ("identify", "trace")}
    return {
        **run.summary.plain(),
        **newest,
        "results": [result.plain() for result in run.results],
    }


def _newest(run: Run, command: str) -> str | None:
    """Return the outcome of the newest result of a command."""
    return next((r.outcome for r in run.results if r.command == command), None)


def _folders(
    root: Path, problem: Callable[[OSError], None] | None
) -> Iterator[tuple[str, list[Path], bool]]:
    """Yield the folders with logs or a result: name relative to root, logs, whether a result."""
    for here, inside, names in os.walk(root, onerror=problem):
        inside[:] = sorted(n for n in inside if n not in _SKIPPED and not n.startswith("."))
        logs = [Path(here, name) for name in sorted(names) if name.endswith(".mcap")]
        if logs or RESULT in names:
            yield os.path.relpath(here, root), logs, RESULT in names


def _known(path: Path) -> dict[str, RunSummary]:
    """Return the summaries in a catalogue by folder; lines of another version are left out."""
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError):
        return {}
    found = {}
    for line in lines:
        try:
            summary = _summary(parse_json(line))
        except (ValueError, TypeError, KeyError):
            continue
        found[summary.folder] = summary
    return found


def _summary(plain: dict[str, Any]) -> RunSummary:
    """Return a summary from JSON data; raises ValueError, TypeError or KeyError for other data."""
    values = {field.name: plain[field.name] for field in fields(RunSummary)}
    kinds = {"str": (str,), "bool": (bool,), "int": (int,), "float": (int, float)}
    for field in fields(RunSummary):
        if not isinstance(values[field.name], kinds[str(field.type)]):
            raise TypeError(field.name)
    summary = RunSummary(**values)
    if datetime.fromisoformat(summary.flown).tzinfo is None:
        raise ValueError(summary.flown)
    return summary


def _results(
    root: Path, names: Sequence[str], summaries: Sequence[RunSummary]
) -> dict[str, list[ResultSummary]]:
    """Return the results of each flight by its folder."""
    found: dict[str, list[ResultSummary]] = {summary.folder: [] for summary in summaries}
    by_path = {str((root / name).resolve()): name for name in found}
    for name in names:
        result = read_result(root / name)
        if result is None:
            continue
        result = replace(result, path=Path(name))
        above = [str(parent) for parent in (Path(name), *Path(name).parents)]
        logged = (by_path.get(str(Path(log).parent)) for log in result.logs)
        owner = next((p for p in above if p in found and p != "."), None)
        owner = owner or next((p for p in logged if p is not None), None)
        owner = owner or ("." if "." in found else None)
        if owner is not None:
            found[owner].append(result)
    return found


def _save(path: Path, runs: Sequence[Run]) -> None:
    """Replace the catalogue if it changes and may be written."""
    text = "".join(json.dumps(plain_run(run)) + "\n" for run in runs)
    try:
        if path.exists() and path.read_text(encoding="utf-8") == text:
            return
        if not runs and not path.exists():
            return
        write_file(path, text)
    except (OSError, UnicodeError):
        return
