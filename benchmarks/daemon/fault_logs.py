"""Check what a fault trial leaves on disk: the logs of its flight and its flight recording."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from levid.daemon.control.faults import Fault
from levid.daemon.control.states import IN_FLIGHT
from levid.log.errors import LogError
from levid.log.reader import Log, read_log

LAST_S = 1.0
"""Longest part that a log may lack at its end."""
_SKIPPED_MORE = 255
"""A row stores this for 255 skipped periods or more: their number is unknown."""
_MARGIN_S = 0.1
"""Tolerance of the recorded time: a dead loop writes no row of its fault."""
_FIRST_S = 0.5
"""A daemon that has just started writes its first row by then."""


@dataclass
class LogCheck:
    """The logs of a flight: their number, those that do not open, missing rows, and problems."""

    logs: int = 0
    unreadable: int = 0
    missing: int = 0
    tail_s: float = 0.0
    wrong: list[str] = field(default_factory=list)


def check_logs(
    paths: Sequence[Path], began: int, until: int, rate_hz: float, may_be_cut: bool = False
) -> LogCheck:
    """Check that the logs contain every cycle in flight and reach from `began` to `until`.

    With `may_be_cut` (disk full, recorder killed) a file may be truncated, but must open if it has
    rows.
    """
    check = LogCheck(len(paths), wrong=[] if paths else ["no log of the flight"])
    found: list[NDArray[np.void]] = []
    for path in paths:
        try:
            log = read_log(path)
        except LogError as error:
            if not may_be_cut:
                check.unreadable += 1
                check.wrong.append(f"unreadable: {error}")
            continue
        found.append(log.rows)
        if not (log.complete or may_be_cut):
            check.wrong.append(f"not complete: {log.problem}")
    last = began
    if found:
        rows = np.concatenate(found)
        rows = rows[np.unique(rows["cycle"], return_index=True)[1]]  # parts may overlap
        last = int(rows["cycle"][-1])
        check.missing = _missing(rows)
    check.tail_s = max(until - last, 0) / rate_hz
    if check.missing:
        check.wrong.append(f"{check.missing} rows are missing")
    if check.tail_s > LAST_S:
        check.wrong.append(f"the last {check.tail_s:.2f} s are missing")
    return check


def _missing(rows: NDArray[np.void]) -> int:
    """Count cycles without a row from lift-off to landing or fault; a dead bus has no rows."""
    flying = np.isin(rows["state"], [int(state) for state in IN_FLIGHT]) & (rows["fault"] == 0)
    at = np.flatnonzero(flying)
    rows = rows[at[0] : at[-1] + 1] if len(at) else rows[:0]
    skipped = rows["skipped"][1:].astype(np.int64)
    lost = np.maximum(np.diff(rows["cycle"].astype(np.int64)) - 1 - skipped, 0)
    return int(lost[skipped < _SKIPPED_MORE].sum())


@dataclass(frozen=True)
class Recording:
    """A flight recording: its file, the fault in its metadata, and its problems."""

    path: Path | None
    name: str
    wrong: tuple[str, ...] = ()


def find_recording(
    recordings: Callable[[], set[Path]], before: set[Path], seconds: float, promised_s: float
) -> Recording:
    """Wait for a complete recording that is not in `before`; check its fault and its length."""
    give_up_s = time.monotonic() + seconds
    problem = "no flight recording"
    while time.monotonic() < give_up_s:
        for path in sorted(recordings() - before):
            try:
                log = read_log(path)
            except LogError as error:  # it may still be written
                problem = str(error)
                continue
            if log.complete:
                name = log.metadata.get("name", "")
                return Recording(path, name, tuple(_problems(log, promised_s)))
            problem = f"the flight recording is not complete: {log.problem}"
        time.sleep(0.05)
    return Recording(None, "nothing", (problem,))


def _problems(log: Log, promised_s: float) -> list[str]:
    """Return what is wrong with a recording: no row of its fault, or too few rows before it."""
    cycles, faults = log.rows["cycle"].astype(np.int64), log.rows["fault"]
    name, at = log.metadata.get("name", ""), len(cycles) - 1
    if name != Fault.LOOP.name:  # a dead loop writes no row of its fault
        came = np.flatnonzero((faults != 0) & (np.r_[0, faults[:-1]] == 0))
        if not len(came) or Fault(int(faults[came[-1]])).name != name:
            return [f"the recording of {name} has no row of this fault"]
        at = came[-1]
    before_s = (cycles[at] - cycles[0]) / log.rate_hz
    if before_s < promised_s - _MARGIN_S and cycles[0] > _FIRST_S * log.rate_hz:
        return [f"the recording covers {before_s:.2f} s before the fault, not {promised_s:g} s"]
    return []
