"""Read dates and times of day from the cells of a table."""

from __future__ import annotations

import functools
import re
from collections.abc import Sequence
from datetime import UTC, datetime, timedelta

import numpy as np
from numpy.typing import NDArray

_MONTHS = ("jan", "feb", "mar", "apr", "may", "jun", "jul", "aug", "sep", "oct", "nov", "dec")
_MONTH_OF = {name: number for number, name in enumerate(_MONTHS, 1)} | {
    **{"mai": 5, "okt": 10, "dez": 12, "mär": 3, "mrz": 3}
}
_DATE = (
    r"(?:(?P<y>\d{4})[-/.](?P<m>\d{1,2})[-/.](?P<d>\d{1,2})"
    r"|(?P<a>\d{1,2})(?P<sep>[-/. ])(?P<b>\d{1,2}|[A-Za-zä]{3,9})\.?(?P=sep)(?P<y2>\d{4}|\d{2}))"
)
_CLOCK = (
    r"(?:(?P<H>\d{1,3}):)?(?P<M>\d{1,3}):(?P<S>\d{2})(?:[.,:](?P<f>\d{1,12}))?"
    r"(?:\s*(?P<ap>[AaPp])\.?[Mm]\.?)?"
)
"""Hours, minutes and seconds, or minutes and seconds as spreadsheets show short times."""
_ZONE = r"(?:\s*(?P<z>Z|UTC|GMT|[-+]\d{2}:?\d{2}))?"
_STAMP = re.compile(
    rf"(?:{_DATE}(?:[T ]\s*|_|$)|(?P<days>\d+) days?,? (?=\d))?(?:{_CLOCK}{_ZONE})?"
)
"""A date, a time of day, or both; a duration such as `0 days 00:00:01.5`."""
_HALF_DAY_H, _DAY_H = 12, 24
_MOST_MINUTES = 60
_ORIGIN = datetime(1970, 1, 1, tzinfo=UTC)


class Stamp:
    """A date, a time of day, or both.

    day_s: seconds from 1970 to midnight of the date, 0 without a date; month_first_day_s: the same
    if the month stands before the day in 01/02/2024; None if there is no such date. clock_s:
    seconds since midnight, minus the offset from UTC. zoned: whether the cell states the offset.
    """

    __slots__ = ("clock_s", "day_s", "has_date", "month_first_day_s", "zoned")

    def __init__(self, cell: str) -> None:
        found = _STAMP.fullmatch(cell.strip())
        if found is None or not (found["S"] or found["y"] or found["a"]):
            raise ValueError(cell)
        self.has_date = bool(found["y"] or found["a"])
        self.zoned = bool(found["z"])
        self.clock_s = _clock_s(found) - _offset_s(found["z"]) if found["S"] else 0.0
        self.day_s = _day_s(found, month_first=False) if self.has_date else 0.0
        self.month_first_day_s = _day_s(found, month_first=True) if self.has_date else 0.0
        if self.day_s is None and self.month_first_day_s is None:
            raise ValueError(cell)


def stamps_s(stamps: Sequence[Stamp | None]) -> NDArray[np.float64]:
    """Return times (N,) in s after the first; NaN for None.

    Dates such as 01/02/2024 have the day first, unless only the month first gives times that exist
    and increase.
    """

    def seconds(*, month_first: bool) -> NDArray[np.float64]:
        days = np.array(
            [
                np.nan if s is None else s.month_first_day_s if month_first else s.day_s
                for s in stamps
            ],
            np.float64,
        )
        known = days[~np.isnan(days)]
        return days - known[0] + clock_s if len(known) else days

    clock_s = np.array([np.nan if s is None else s.clock_s for s in stamps], np.float64)
    known = np.array([s is not None for s in stamps], bool)
    found = [seconds(month_first=month_first) for month_first in (False, True)]
    valid = [not np.isnan(each[known]).any() for each in found]
    rising = [bool(np.all(np.diff(each[known]) >= 0.0)) for each in found]
    chosen = found[1] if (valid[1], rising[1]) > (valid[0], rising[0]) else found[0]
    return chosen - chosen[known][0] if known.any() else chosen


def stamp(cell: str) -> Stamp | None:
    """Return the date or time of day in a cell; None for other text."""
    if not cell[:1].isdigit():
        return None
    try:
        return Stamp(cell)
    except ValueError:
        return None


def _clock_s(found: re.Match[str]) -> float:
    hours, minutes, seconds = int(found["H"] or 0), int(found["M"]), int(found["S"])
    if seconds > _MOST_MINUTES or (found["H"] and minutes >= _MOST_MINUTES):
        raise ValueError(found.string)
    if found["ap"]:
        hours = hours % _HALF_DAY_H + (_HALF_DAY_H if found["ap"] in "pP" else 0)
    if (found["y"] or found["a"]) and hours >= _DAY_H:
        raise ValueError(found.string)
    return (
        86400.0 * int(found["days"] or 0)
        + 3600.0 * hours
        + 60.0 * minutes
        + seconds
        + float(f"0.{found['f'] or 0}")
    )


def _offset_s(zone: str | None) -> float:
    if zone is None or zone[0] not in "+-":
        return 0.0
    digits = zone[1:].replace(":", "")
    return float(zone[0] + "1") * (3600.0 * int(digits[:2]) + 60.0 * int(digits[2:]))


def _day_s(found: re.Match[str], *, month_first: bool) -> float | None:
    """Return the seconds from 1970 to the date's midnight; None if there is no such date."""
    if found["y"]:
        return _midnight_s(int(found["y"]), int(found["m"]), int(found["d"]))
    year = int(found["y2"]) + (2000 if len(found["y2"]) == 2 else 0)
    first, second = int(found["a"]), found["b"]
    if not second.isdigit():
        return _midnight_s(year, _MONTH_OF.get(second[:3].lower(), 0), first)
    return (
        _midnight_s(year, first, int(second))
        if month_first
        else _midnight_s(year, int(second), first)
    )


@functools.cache
def _midnight_s(year: int, month: int, day: int) -> float | None:
    try:
        return (datetime(year, month, day, tzinfo=UTC) - _ORIGIN) / timedelta(seconds=1)
    except ValueError:
        return None
