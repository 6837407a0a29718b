"""What a trial left on disk: the logs of its flight, and the recording of its fault."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from levid.daemon.control.faults import Fault
from levid.daemon.control.states import IN_FLIGHT
from levid.log.errors import LogError
from levid.log.reader import Log, read_log

LAST_S = 1.0
"""What a log may lack where its disk was full or its recorder killed."""
_SKIPPED_MORE = 255
"""What a row says of so many skipped periods or more: how many, it does not know."""
_AGAIN_S = 0.05
_MARGIN_S = 0.1
"""A loop that died has no row of its fault: how far back it looks is counted from its last."""
_FIRST_S = 0.5
"""By when a loop that was just started has written its first row."""


@dataclass(frozen=True)
class Expected:
    """What the logs of a flight are to hold: rows from cycle `began` to `until`.

    cut: its disk was full, its files may end anywhere. parted: its recorder was killed, files but
    the last one may.
    """

    began: int
    until: int
    rate_hz: float
    cut: bool = False
    parted: bool = False


@dataclass
class LogLook:
    """How many logs a flight left, what is wrong with them, and how far from the end they stop.

    rowless: on a full disk, before a first row was whole. rows: in flight, before any fault; late
    of them came late. missing: that should be among them.
    """

    logs: int = 0
    unreadable: int = 0
    rowless: int = 0
    incomplete: int = 0
    rows: int = 0
    late: int = 0
    missing: int = 0
    tail_s: float = 0.0
    wrong: list[str] = field(default_factory=list)


def look_at_logs(paths: Sequence[Path], expected: Expected) -> LogLook:
    """Read all logs of a flight, however many files it has."""
    look = LogLook(len(paths))
    if not paths:
        look.wrong.append("no log of the flight")
    found: list[NDArray[np.void]] = []
    for path in paths:
        may_end = expected.cut or (expected.parted and path != _newest(paths))
        try:
            log = read_log(path)
        except Exception as error:  # noqa: BLE001 - whatever it is, it does not open
            if expected.cut and isinstance(error, LogError):
                look.rowless += 1  # if it should have had rows, the end is missing
            else:
                look.unreadable += 1
                look.wrong.append(f"unreadable: {error}")
            continue
        found.append(log.rows)
        if not (log.complete or may_end):
            look.incomplete += 1
            look.wrong.append(f"not complete: {log.problem}")
    _count(look, found, expected)
    return look


def _count(look: LogLook, found: list[NDArray[np.void]], expected: Expected) -> None:
    last = expected.began
    if found:
        rows = np.concatenate(found)
        _, first = np.unique(rows["cycle"], return_index=True)  # parts of one may overlap
        rows = rows[first]
        last = int(rows["cycle"][-1])
        rows = _in_flight(rows)
        look.rows, look.late = len(rows), int((rows["skipped"][1:] > 0).sum())
        periods = np.diff(rows["cycle"].astype(np.int64)) - 1
        skipped = rows["skipped"][1:]
        lost = np.maximum(periods - skipped, 0)
        look.missing = int(lost[skipped < _SKIPPED_MORE].sum())
        if look.missing:
            look.wrong.append(f"{look.missing} rows are missing")
    look.tail_s = max(expected.until - last, 0) / expected.rate_hz
    if look.tail_s > LAST_S:
        look.wrong.append(f"the last {look.tail_s:.2f} s are missing")


def _in_flight(rows: NDArray[np.void]) -> NDArray[np.void]:
    """Return the rows from lift-off to landing or fault: behind it a dead bus has none."""
    flying = np.isin(rows["state"], [int(state) for state in IN_FLIGHT]) & (rows["fault"] == 0)
    at = np.flatnonzero(flying)
    return rows[at[0] : at[-1] + 1] if len(at) else rows[:0]


def _newest(paths: Sequence[Path]) -> Path:
    return max(paths, key=lambda path: path.stat().st_mtime_ns)


@dataclass(frozen=True)
class Recording:
    """The recording of a fault: where it is, the name in its metadata, and what is wrong."""

    path: Path | None
    name: str
    wrong: tuple[str, ...] = ()


def recording_of(
    recordings: Callable[[], set[Path]],
    before: set[Path],
    since: int,
    seconds: float,
    promised_s: float,
) -> Recording:
    """Wait so long for a recording that was not there before, and look at it.

    since: the cycle before the fault was brought about. promised_s: how far it is to look back.
    """
    give_up_s = time.monotonic() + seconds
    while True:
        new = sorted(recordings() - before)
        problem = "no flight recording"
        for path in new:
            try:
                log = read_log(path)
            except Exception as error:  # noqa: BLE001 - as above, or it is being written
                problem = str(error)
                continue
            if log.complete:
                more = () if len(new) == 1 else (f"{len(new)} flight recordings",)
                return Recording(
                    path, log.metadata.get("name", ""), (*more, *_wrong(log, since, promised_s))
                )
            problem = f"the flight recording is not complete: {log.problem}"
        if time.monotonic() > give_up_s:
            return Recording(None, "nothing", (problem,))
        time.sleep(_AGAIN_S)


def _wrong(log: Log, since: int, promised_s: float) -> list[str]:
    """Return what is wrong with the story that it tells."""
    rows: Any = log.rows
    name = log.metadata.get("name", "")
    if name == Fault.LOOP.name:  # who is dead writes no row of it
        reaches = int(rows["cycle"][-1])
        early = (
            [] if reaches >= since - 1 else [f"the recording ends {since - reaches} cycles early"]
        )
        return early + _short(log, reaches, promised_s)
    came = np.flatnonzero((rows["fault"] != 0) & (np.r_[0, rows["fault"][:-1]] == 0))
    if not len(came):
        return ["the recording has no row of the fault"]
    first = rows[came[-1]]  # what came before is another trial's
    wrong = _short(log, int(first["cycle"]), promised_s)
    if Fault(int(first["fault"])).name != name:
        wrong.append(f"the recording of {name} has rows of {Fault(int(first['fault'])).name}")
    if int(first["cycle"]) < since:
        wrong.append(f"the fault is recorded {since - int(first['cycle'])} cycles before it came")
    return wrong


def _short(log: Log, fault: int, promised_s: float) -> list[str]:
    """Say so if it does not reach as far back from the fault's cycle as was promised.

    Of a daemon that was just started there are no more rows than from its first on.
    """
    first = int(log.rows["cycle"][0])
    before_s = (fault - first) / log.rate_hz
    if before_s >= promised_s - _MARGIN_S or first <= _FIRST_S * log.rate_hz:
        return []
    return [f"the recording looks {before_s:.2f} s back, of {promised_s:g} s"]
