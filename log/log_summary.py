"""Summarise a log: who flew it, when, how long, and what went wrong."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

import numpy as np

from ..config.base import ConfigError, mapping_of
from .exporting.columns import Column, chosen_columns
from .exporting.export_log import time_of
from .log_facts import file_date, flight_date, is_virtual, rig_name, versions
from .log_stream import LogStream

_AT_LIMIT = 1.0 - 1e-6


@dataclass(frozen=True)
class LogSummary:
    """What a log holds.

    flown: date in UTC; of a virtual flight or imported data the date of the file. begin_s, end_s:
    of `time_s`. faults: codes of `fault` in the log, 0 left out. skipped: periods without a cycle
    since the first row. late: cycles that started more than half a period late. saturated_rows:
    cycles with a coil at a limit, saturated_coils: the coils at the force limit of the attached
    rig in these cycles. problem: why the log is incomplete. columns: all fields. versions: of
    programs.
    """

    path: Path
    kind: str
    name: str
    rig: str
    session: str
    note: str
    flown: datetime
    virtual: bool
    rate_hz: float
    rows: int
    begin_s: float
    end_s: float
    beam_m: tuple[float, float] | None
    faults: tuple[int, ...]
    skipped: int
    late: int
    saturated_rows: int
    saturated_coils: tuple[int, ...]
    problem: str | None
    columns: tuple[Column, ...]
    versions: dict[str, str]
    file_bytes: int

    @property
    def length_s(self) -> float:
        """Time that the rows cover, a period for each."""
        return self.end_s - self.begin_s + 1.0 / self.rate_hz


class _Counts:
    def __init__(self, log: LogStream) -> None:
        self.log, self.limit_n = log, _coil_limit_n(log)
        self.rows, self.skipped, self.late, self.saturated = 0, 0, 0, 0
        self.begin_s, self.end_s = 0.0, 0.0
        self.faults: set[int] = set()
        self.coils: set[int] = set()
        self.beam = [np.inf, -np.inf]

    def run(self) -> None:
        names = self.log.names
        for block in self.log.blocks():
            rows, t = block.rows, time_of(self.log, block)
            if not self.rows:
                self.begin_s = float(t[0])
            self.end_s = float(t[-1])
            if "fault" in names:
                self.faults |= set(np.unique(rows["fault"]).tolist()) - {0}
            if "skipped" in names:
                self.skipped += int(rows["skipped"][int(not self.rows) :].sum(dtype=np.int64))
            if "lateness_s" in names:
                self.late += int(np.count_nonzero(rows["lateness_s"] > 0.5 / self.log.rate_hz))
            if "saturated" in names:
                limited = rows[rows["saturated"] > 0]
                self.saturated += len(limited)
                if len(limited) and "coil_n" in names and self.limit_n is not None:
                    at_limit = np.abs(limited["coil_n"]) >= _AT_LIMIT * self.limit_n
                    self.coils |= set(np.flatnonzero(at_limit.any(axis=0)).tolist())
            if "beam_m" in names:
                known = rows["beam_m"][np.isfinite(rows["beam_m"])]
                self.beam = [
                    float(known.min(initial=self.beam[0])),
                    float(known.max(initial=self.beam[1])),
                ]
            self.rows += len(rows)


def summarise_log(path: Path | str) -> LogSummary:
    """Return a summary of a log, read block by block; raises LogError."""
    log = LogStream(path)
    counts = _Counts(log)
    first = log.first_block()
    first_ns = 0 if first is None else int(first.log_time_ns[0])
    counts.run()
    metadata = log.metadata
    return LogSummary(
        path=log.path,
        kind=metadata.get("kind", ""),
        name=metadata.get("name", log.path.stem),
        rig=rig_name(log.attachments),
        session=metadata.get("session", ""),
        note=metadata.get("note", ""),
        flown=flight_date(first_ns, log.attachments) or file_date(log.path),
        virtual=is_virtual(first_ns),
        rate_hz=log.rate_hz,
        rows=counts.rows,
        begin_s=counts.begin_s,
        end_s=counts.end_s,
        beam_m=(counts.beam[0], counts.beam[1]) if counts.beam[0] <= counts.beam[1] else None,
        faults=tuple(sorted(counts.faults)),
        skipped=counts.skipped,
        late=counts.late,
        saturated_rows=counts.saturated,
        saturated_coils=tuple(sorted(counts.coils)),
        problem=log.problem,
        columns=chosen_columns(log),
        versions=versions(log.attachments),
        file_bytes=log.file_bytes,
    )


def _coil_limit_n(log: LogStream) -> float | None:
    """Return the force limit of a coil in N in the attached rig, None if it is not known."""
    try:
        rig = mapping_of(log.attachments.get("rig.yaml", b""), "rig.yaml")
        return float(rig["limits"]["coil_n"])
    except (ConfigError, TypeError, KeyError, ValueError, OverflowError):
        return None
