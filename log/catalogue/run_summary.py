"""Summarise the logs of one folder from their heads and last rows, without reading all of them."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from hashlib import blake2s
from pathlib import Path
from typing import Any

import numpy as np

from ..exporting.export_log import time_of
from ..log_facts import file_date, flight_date, is_virtual, rig_name, versions
from ..log_stream import Block, LogStream


@dataclass(frozen=True)
class RunSummary:
    """One flight, or one folder of imported logs.

    folder: relative to the catalogue's. flown: date in UTC, ISO 8601; of a virtual flight or
    imported data the date of the newest file. logs, records: numbers. length_s: sum over the logs.
    fault: code of the fault that ended the flight, 0 for none. incomplete: logs that are cut off or
    damaged. unflown: steps of the session without a log. unreadable: files that are no logs.
    state: a hash of names, sizes and dates of the logs, which tells whether the summary is up to
    date.
    """

    folder: str
    flown: str
    virtual: bool
    rig: str
    session: str
    note: str
    rate_hz: float
    logs: int
    records: int
    rows: int
    length_s: float
    fault: int
    incomplete: int
    unflown: int
    unreadable: int
    bytes: int
    levid: str
    state: str

    def plain(self) -> dict[str, Any]:
        """Return the summary as JSON data."""
        return asdict(self)


def state_of(logs: Sequence[Path]) -> str:
    """Return a text that changes if a log is written, added or removed."""
    parts = []
    for path in logs:
        found = _status(path)
        parts.append(f"{path.name}:{found.st_size}:{found.st_mtime_ns}" if found else path.name)
    return blake2s("|".join(parts).encode(errors="replace"), digest_size=8).hexdigest()


def summarise_run(folder: str, logs: Sequence[Path]) -> RunSummary:
    """Return the summary of the logs in a folder: not all rows are read.

    A fault is in the last rows of a log: the loop stops recording 0.5 s after it.
    """
    found, unreadable = [], 0
    for path in logs:
        try:
            found.append(_LogHead(path))
        except Exception:  # noqa: BLE001 - no file may hide the other flights
            unreadable += 1
    first = min(found, key=lambda log: log.begin_s, default=None)
    flown = (first and first.flown) or file_date(*logs)
    return RunSummary(
        folder=folder,
        flown=flown.isoformat(timespec="seconds"),
        virtual=first is not None and first.virtual,
        rig="" if first is None else first.rig,
        session="" if first is None else first.session,
        note="" if first is None else first.note,
        rate_hz=0.0 if first is None else first.rate_hz,
        logs=len(logs),
        records=sum(log.kind in ("record", "import") for log in found),
        rows=sum(log.rows for log in found),
        length_s=round(sum(log.length_s for log in found), 6),
        fault=max((log.fault for log in found), default=0),
        incomplete=sum(log.incomplete for log in found),
        unflown=max(unflown_steps([log.metadata for log in found]) - unreadable, 0),
        unreadable=unreadable,
        bytes=sum(status.st_size for status in map(_status, logs) if status is not None),
        levid="" if first is None else first.levid,
        state=state_of(logs),
    )


def unflown_steps(metadata: Iterable[Mapping[str, str]]) -> int:
    """Return the steps of a session that have no log, from the metadata of its logs."""
    steps, flown = 0, set()
    for facts in metadata:
        if facts.get("steps", "").isdecimal():
            steps = max(steps, int(facts["steps"]))
            flown.add(facts.get("step"))
    return max(steps - len(flown), 0)


def _status(path: Path) -> os.stat_result | None:
    """Return the status of a log; None for a link that leads nowhere, or without rights."""
    try:
        return path.stat()
    except OSError:
        return None


class _LogHead:
    """Summarise a log from its head, its first chunk and its last one."""

    def __init__(self, path: Path) -> None:
        log = LogStream(path)
        first = log.first_block()
        assert first is not None  # a LogStream without rows is an error
        last = log.last_block() or first
        first_ns = int(first.log_time_ns[0])
        self.virtual = is_virtual(first_ns)
        self.flown = flight_date(first_ns, log.attachments)
        self.rig = rig_name(log.attachments)
        self.metadata = metadata = log.metadata
        self.session, self.note = metadata.get("session", ""), metadata.get("note", "")
        self.kind, self.rate_hz = metadata.get("kind", ""), log.rate_hz
        self.levid = versions(log.attachments).get("levid", "")
        self.begin_s = float(time_of(log, first)[0])
        end_s = float(time_of(log, last)[-1])
        self.length_s = end_s - self.begin_s + 1.0 / log.rate_hz
        self.rows = log.stated_rows or _rows_between(log, first, last)
        self.fault = int(last.rows["fault"].max()) if "fault" in log.names else 0
        self.incomplete = log.problem is not None


def _rows_between(log: LogStream, first: Block, last: Block) -> int:
    """Return the number of rows of a log that was cut off, before it could state it."""
    if "cycle" in log.names:
        return int(last.rows["cycle"][-1] - first.rows["cycle"][0]) + 1
    spanned = float(time_of(log, last)[-1] - time_of(log, first)[0])
    return int(np.rint(spanned * log.rate_hz)) + 1
