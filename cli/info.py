"""`levid info`: describe logs, folders of logs and results at one glance."""

from __future__ import annotations

import json
from collections.abc import Sequence
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from ..config.escaping import one_line
from .path_types import LOG
from .progress import progress, say
from .text_table import text_table

if TYPE_CHECKING:
    from ..log.catalogue.results import ResultSummary
    from ..log.log_summary import LogSummary

_SHOWN_VERSIONS = ("levid", "python", "numpy")


@click.command("info")
@click.argument("paths", nargs=-1, required=True, type=LOG)
@click.option("--columns", is_flag=True, help="Also list the columns of each kind of log.")
@click.option("--json", "as_json", is_flag=True, help="Print one JSON object.")
def command(paths: tuple[Path, ...], columns: bool, as_json: bool) -> int:
    """Describe PATHS: logs, folders of logs, or results of identify and trace.

    Shows rig, session, date, rate, length, records and versions; and what went wrong: faults,
    skipped cycles, coils at a limit, logs that are cut off. A path that cannot be read is named,
    and the others are described. Exits with 1 if a log is incomplete or a path cannot be read.

    \b
    Examples:
      levid info out/first
      levid info out/first/02-left-psi.mcap --columns
      levid info out/first/identification
      levid info out/first --json
    """
    from ..log.errors import LogError
    from ..log.log_summary import summarise_log

    logs, results, errors = _contents(paths)
    found = []
    with progress("reading") as report:
        for number, path in enumerate(logs):
            report(path.name, number / len(logs))
            try:
                found.append(summarise_log(path))
            except (LogError, OSError) as error:
                errors.append((path, str(error)))
    if as_json:
        plain = {
            "logs": [_plain(log) for log in found],
            "results": [result.plain() for result in results],
            "errors": [{"path": str(path), "error": text} for path, text in errors],
        }
        click.echo(json.dumps(plain))
    else:
        lines = [line for result in results for line in _result_lines(result)]
        for part in (_log_lines(found), *([_column_lines(found)] if columns else [])):
            lines += ([""] if lines and part else []) + part
        for line in lines:
            click.echo(line)
    for _, text in errors:
        say(f"error: {text}")
    return 1 if errors or any(log.problem for log in found) else 0


def _contents(
    paths: Sequence[Path],
) -> tuple[list[Path], list[ResultSummary], list[tuple[Path, str]]]:
    """Return the logs and results that the paths name, and the errors of paths with neither."""
    from ..log.catalogue.results import read_result

    logs: list[Path] = []
    results: list[ResultSummary] = []
    errors: list[tuple[Path, str]] = []
    for path in paths:
        if not path.is_dir():
            logs.append(path)
            continue
        try:
            inside = sorted(path.iterdir())
        except OSError as error:
            errors.append((path, f"{path}: {error.strerror}"))
            continue
        own = [file for file in inside if file.suffix == ".mcap"]
        beside = [read_result(f) for f in (path, *inside) if f.is_dir()]
        known = [result for result in beside if result is not None]
        if not own and not known:
            text = (
                f"{path}: expected logs (*.mcap) or a result of identify or trace, found neither; "
                "`levid list` searches folders inside"
            )
            errors.append((path, text))
        logs += own
        results += known
    return logs, results, errors


def _result_lines(result: ResultSummary) -> list[str]:
    of = f" of {len(result.logs)} log{'s' * (len(result.logs) != 1)}" if result.logs else ""
    return [
        f"{one_line(str(result.path))}: {result.command}{of}, {result.written:%Y-%m-%d %H:%M} UTC",
        f"  {result.outcome}",
    ]


def _log_lines(logs: Sequence[LogSummary]) -> list[str]:
    """Return a head for each session of a folder, and a table of its logs."""
    lines: list[str] = []
    for (folder, session), group in groupby(logs, key=lambda log: (log.path.parent, log.session)):
        own = list(group)
        first = own[0]
        lines += [""] if lines else []
        about = [f"rig {first.rig}"] if first.rig else []
        about += [f"session {session}"] if session else []
        virtual = ", virtual time" if first.virtual else ""
        about.append(f"{first.flown.astimezone():%Y-%m-%d %H:%M %Z}{virtual}")
        about.append(f"{first.rate_hz:g} Hz")
        records = sum(log.kind == "record" for log in own)
        about += [f"{records} record{'s' * (records != 1)}"] if records else []
        about.append(f"{sum(log.length_s for log in own):.6g} s")
        about.append(f"{sum(log.file_bytes for log in own) / 1e6:.3g} MB")
        lines.append(f"{one_line(str(folder))}: {', '.join(about)}")
        lines += [f"  note: {first.note}"] if first.note else []
        table = text_table(
            ("log", "kind", "begin s", "length s", "rows", "beam mm", "remarks"),
            [_row(log) for log in own],
            right=(2, 3, 4, 5),
        )
        lines += [f"  {line}" for line in table]
        programs = [f"{n} {first.versions[n]}" for n in _SHOWN_VERSIONS if n in first.versions]
        lines += [f"  flown with {', '.join(programs)}"] if programs else []
    return lines


def _row(log: LogSummary) -> tuple[str, ...]:
    beam = ""
    if log.beam_m is not None:
        low, high = (f"{1e3 * x:z.0f}" for x in log.beam_m)
        beam = low if low == high else f"{low} to {high}"
    return (
        log.path.name,
        log.kind,
        f"{log.begin_s:.3f}",
        f"{log.length_s:.3f}",
        str(log.rows),
        beam,
        "; ".join(_remarks(log)) or "none",
    )


def _remarks(log: LogSummary) -> list[str]:
    words = [f"FAULT {text}" for text in map(fault_text, log.faults)]
    if log.problem:
        words.append(f"incomplete: {log.problem}")
    if log.skipped:
        words.append(f"{log.skipped} periods skipped")
    if log.late:
        words.append(f"{log.late} cycles late by half a period")
    if log.saturated_rows:
        coils = ", ".join(map(str, log.saturated_coils))
        which = f"coil {coils}" if coils else "a coil"
        words.append(f"{which} at a limit in {log.saturated_rows} cycles")
    return words


def fault_text(code: int) -> str:
    """Return name and cause of a fault by its code in the log."""
    from ..daemon.control.faults import FAULTS, Fault

    name = fault_name(code)
    known = name in Fault.__members__
    return f"{name}: {FAULTS[Fault[name]].cause if known else 'not known to this version of levid'}"


def fault_name(code: int) -> str:
    """Return the name of a fault by its code in the log; the code if it is not known."""
    from ..log.cycle_codes import Fault

    try:
        return Fault(code).name
    except ValueError:
        return str(code)


def _column_lines(logs: Sequence[LogSummary]) -> list[str]:
    """Return a table of the columns; logs with equal columns share one."""
    lines: list[str] = []
    shown: list[object] = []
    for log in logs:
        if log.columns in shown:
            continue
        shown.append(log.columns)
        title = f"columns of {one_line(str(log.path))}:"
        lines += ["", title] if lines else [title]
        rows = [
            (c.name, "" if c.length is None else str(c.length), c.unit, str(c.dtype), c.meaning)
            for c in log.columns
        ]
        table = text_table(("column", "values", "unit", "type", "meaning"), rows, right=(1,))
        lines += [f"  {line}" for line in table]
    return lines


def _plain(log: LogSummary) -> dict[str, Any]:
    return {
        "path": str(log.path),
        "kind": log.kind,
        "name": log.name,
        "rig": log.rig,
        "session": log.session,
        "note": log.note,
        "flown": log.flown.isoformat(timespec="seconds"),
        "virtual": log.virtual,
        "rate_hz": log.rate_hz,
        "rows": log.rows,
        "begin_s": log.begin_s,
        "end_s": log.end_s,
        "length_s": log.length_s,
        "beam_m": log.beam_m,
        "faults": [fault_name(code) for code in log.faults],
        "skipped": log.skipped,
        "late": log.late,
        "saturated_rows": log.saturated_rows,
        "saturated_coils": log.saturated_coils,
        "problem": log.problem,
        "versions": log.versions,
        "bytes": log.file_bytes,
        "columns": [
            {"name": c.name, "unit": c.unit, "length": c.length, "type": str(c.dtype)}
            for c in log.columns
        ],
    }
