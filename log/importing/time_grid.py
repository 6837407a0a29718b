"""Place rows on a uniform time grid by their time stamps."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from ..errors import LogError

Array = NDArray[np.float64]
Index = NDArray[np.int64]

LONGEST_FILLED_ROWS = 5
"""Longest run of missing rows that is filled in; longer ones split the data."""
ACCEPTED_JITTER = 0.1
"""Largest distance of a stamp from the grid, over the period. For a sine with ten samples a period
the error of such a sample is 6 % of the amplitude."""
LATE_SHARE = 0.01
"""Largest share of rows with a stamp beyond ACCEPTED_JITTER: single late stamps of a busy computer.
"""
_MIN_ROWS = 3
_WINDOW_ROWS = 50
_LEAST_REPEATS, _LEAST_REPEATED_SHARE = 5, 0.05
"""Least number and share of rows with the time of the row before, if stamps are coarse; fewer are
rows that were written twice."""
_COARSE = 0.25
"""Resolution of stamps, in periods, above which steps between rows do not count periods."""
_MOST_RESOLUTION = 2.0
"""Coarsest resolution of stamps that is recognised, in periods."""
_SECTIONS = 4
"""Sections of the data whose resolution is determined."""
_MOST_DRIFT = 0.1
"""Largest error at the end of the data, in periods, of a rate that is rounded to few digits."""


@dataclass(frozen=True)
class GridPart:
    """Rows first to end (exclusive) without a long gap, and their places (n,) on the grid.

    Places count periods since the first row of the data.
    """

    first: int
    end: int
    place: Index


@dataclass(frozen=True)
class TimeGrid:
    """A uniform grid, and how well the time stamps fit it.

    jitter (N,): distance of each stamp from the grid, in periods. resolution_s: the stamps are
    multiples of it; 0 if it is negligible.
    """

    period_s: float
    parts: tuple[GridPart, ...]
    jitter: Array
    resolution_s: float

    @property
    def off_grid(self) -> NDArray[np.bool_]:
        """Which stamps (N,) are further from the grid than jitter and resolution explain."""
        accepted = ACCEPTED_JITTER + 0.5 * self.resolution_s / self.period_s
        return np.asarray(np.abs(self.jitter) > accepted)

    @property
    def regular(self) -> bool:
        """Whether the rows are samples at a constant rate."""
        return bool(np.mean(self.off_grid) <= LATE_SHARE)

    def notes(self) -> list[str]:
        """Return remarks on the time stamps of a regular grid."""
        off, jitter = self.off_grid, np.abs(self.jitter)
        found = []
        if jitter.max() > ACCEPTED_JITTER and self.resolution_s > ACCEPTED_JITTER * self.period_s:
            found.append(f"time stamps are rounded to {self.resolution_s:g} s, which is accepted")
        elif jitter.max() > 1e-3:
            usual = jitter[~off]
            found.append(
                f"time stamps jitter by up to {100 * usual.max():.2g} % of the period "
                f"(RMS {100 * np.sqrt(np.mean(usual**2)):.2g} %); the rows are placed on a uniform "
                "grid"
            )
        if off.any():
            found.append(
                f"{np.count_nonzero(off)} time stamps are up to {jitter.max():.2g} periods off the "
                "grid (late stamps of a busy computer); their rows are used as if on time"
            )
        return found


def fit_grid(
    where: str, time_s: Array, row: Index, stated_period_s: float | None = None
) -> TimeGrid:
    """Fit a uniform grid to time stamps (N,) in s, which do not decrease.

    `row` (N,) are their rows in the file.

    The rate follows from the whole record, not from single steps: stamps that are rounded to about
    a period step by other amounts. Rows are missing only if the stamps do not fit a grid without
    missing rows. A stamp may be late, which delays only itself and the few rows behind it; a
    missing row delays all rows after it. stated_period_s: the period that the user states, which
    decides where the stamps allow it.

    Raises:
        LogError: fewer than three stamps, or stamps that do not increase.
    """
    if len(time_s) < _MIN_ROWS:
        raise LogError(f"{where}: expected at least {_MIN_ROWS} times, found {len(time_s)}")
    resolution_s = _float32_resolution(time_s)
    time_s = time_s - time_s[0]
    steps = np.diff(time_s)
    rough_s = _rough_period(time_s)
    mean_s = float(time_s[-1] - time_s[0]) / (len(time_s) - 1)
    if stated_period_s is not None and (
        _stated_fits(rough_s, stated_period_s, len(time_s))
        or _stated_fits(mean_s, stated_period_s, len(time_s))
    ):
        rough_s = stated_period_s
    if rough_s > 0.0:
        # Stamps with few digits become coarser as they grow.
        sections = min(_SECTIONS, len(time_s) // _MIN_ROWS)
        for some in np.array_split(time_s, sections):
            resolution_s = max(resolution_s, _resolution(some - some[0], rough_s))
    coarsest_s = _MOST_RESOLUTION * rough_s if stated_period_s is None else np.inf
    if not 0.5 * rough_s < resolution_s <= coarsest_s or rough_s <= 0.0:
        _check_order(where, steps, row)
    whole = _without_missing_rows(time_s, resolution_s, (rough_s, stated_period_s))
    if whole is not None:
        return whole
    cuts = np.flatnonzero(steps > (LONGEST_FILLED_ROWS + 1.5) * rough_s) + 1
    edges = [0, *cuts.tolist(), len(time_s)]
    bounds = list(pairwise(edges))
    if resolution_s > _COARSE * rough_s:
        place = _places_of_coarse_stamps(time_s, rough_s, resolution_s)
    else:
        # Rounded steps count periods; the sum is right even if a late stamp makes one too long.
        place = np.concatenate([[0], np.cumsum(np.rint(steps / rough_s))])
    period_s = _fit_period(time_s, place, bounds, rough_s)
    for _ in range(2):
        place = _places(time_s, place, period_s, bounds)
        period_s = _fit_period(time_s, place, bounds, period_s)
    jitter = np.empty(len(time_s))
    parts = []
    for first, end in bounds:
        late = time_s[first:end] / period_s - place[first:end]
        start = float(np.median(late))
        jitter[first:end] = late - start
        moved = place[first:end] + round(start)
        parts.append(GridPart(first, end, moved.astype(np.int64)))
    shift = parts[0].place[0]
    parts = [GridPart(p.first, p.end, p.place - shift) for p in parts]
    return TimeGrid(_rounded(period_s, len(time_s)), tuple(parts), jitter, resolution_s)


def _check_order(where: str, steps: Array, row: Index) -> None:
    same = np.flatnonzero(steps <= 0.0)
    if len(same):
        more = f" and {len(same) - 1} more" if len(same) > 1 else ""
        raise LogError(
            f"{where}: expected times that increase from row to row, found the same time and other "
            f"values in rows {row[same[0]]} and {row[same[0] + 1]}{more}; if all rows were sampled "
            "regularly, as where a computer writes blocks of rows, set rate_hz and give this "
            "column the role other; if not, delete one row of each pair"
        )


def _rough_period(time_s: Array) -> float:
    """Return the median step over windows: rounded stamps and a few gaps do not matter."""
    rows = min(_WINDOW_ROWS, len(time_s) - 1)
    return float(np.median(time_s[rows:] - time_s[:-rows])) / rows


def _stated_fits(rough_s: float, stated_s: float, rows: int) -> bool:
    """Return whether the stated period may be that of the stamps; else the import reports it."""
    return abs(rough_s / stated_s - 1.0) < max(0.05, 2.0 / min(rows, _WINDOW_ROWS))


def _resolution(time_s: Array, period_s: float) -> float:
    """Return the largest step in s of which all stamps are multiples; 0 if it is negligible."""
    steps = np.diff(time_s)
    equal = np.count_nonzero(steps == 0.0)
    repeats = equal >= max(_LEAST_REPEATS, _LEAST_REPEATED_SHARE * len(steps))
    steps = np.unique(steps[steps > 1e-3 * period_s])
    if not len(steps):
        return 0.0
    step_s = float(steps[0])
    for other_s in steps[:: max(1, len(steps) // 1000)].tolist():
        rest = abs(other_s - round(other_s / step_s) * step_s)
        while rest > 1e-3 * step_s:  # Euclid's algorithm
            step_s, rest = rest, abs(step_s - round(step_s / rest) * rest)
            if step_s < 0.01 * period_s:
                return 0.0
    multiples = time_s / step_s
    regular = np.abs(multiples - np.rint(multiples)).max() < 0.05
    return step_s if regular and (repeats or not _all_equal(steps, step_s)) else 0.0


def _all_equal(steps: Array, step_s: float) -> bool:
    """Return whether the only step is the period: then nothing is known of the resolution."""
    return len(steps) == 1 or bool(np.all(np.abs(steps / step_s - 1.0) < 1e-3))


def _float32_resolution(time_s: Array) -> float:
    """Return the resolution in s of stamps that were stored in 32 bit, at the largest; else 0."""
    stored = time_s.astype(np.float32)
    if np.array_equal(stored.astype(np.float64), time_s) and not np.all(time_s == np.rint(time_s)):
        return float(np.spacing(np.abs(stored).max()))
    return 0.0


def _without_missing_rows(
    time_s: Array, resolution_s: float, periods_s: Sequence[float | None]
) -> TimeGrid | None:
    """Return the grid of stamps that fit one without missing rows; None if they do not."""
    place = np.arange(len(time_s))
    bounds = [(0, len(time_s))]
    for period_s in (_fit_period(time_s, place.astype(np.float64), bounds, 0.0), *periods_s):
        if not period_s:
            continue
        jitter = time_s / period_s - place
        jitter = jitter - 0.5 * (jitter.max() + jitter.min())
        accepted = ACCEPTED_JITTER + 0.5 * resolution_s / period_s
        if np.abs(jitter).max() <= accepted:
            part = GridPart(0, len(time_s), place.astype(np.int64))
            rounded_s = _rounded(period_s, len(time_s))
            return TimeGrid(rounded_s, (part,), jitter, resolution_s)
    return None


def _places_of_coarse_stamps(time_s: Array, period_s: float, resolution_s: float) -> Array:
    """Return the places of stamps that are rounded to about a period, or more.

    A missing row moves the mean of the stamps after it against the mean of those before it.
    """
    rows = np.arange(len(time_s))
    width = int(10 + 20 * (resolution_s / period_s) ** 2)
    if len(time_s) < 4 * width:
        return rows.astype(np.float64)
    offset = time_s / period_s - rows
    total = np.concatenate([[0.0], np.cumsum(offset)])
    middle = np.arange(width, len(time_s) - width + 1)
    moved = (total[middle + width] - 2.0 * total[middle] + total[middle - width]) / width
    missing = np.zeros(len(time_s))
    while len(moved) and moved.max() > 0.5:
        at = int(np.argmax(moved))
        missing[middle[at]] += round(float(moved[at]))
        moved[max(0, at - width) : at + width] = 0.0
    return np.asarray(rows + np.cumsum(missing))


def _fit_period(
    time_s: Array, place: Array, bounds: Sequence[tuple[int, int]], default_s: float
) -> float:
    """Return the slope of stamps over places, with an offset for each part."""
    product = square = 0.0
    for first, end in bounds:
        at = place[first:end] - np.mean(place[first:end])
        product += float(at @ (time_s[first:end] - np.mean(time_s[first:end])))
        square += float(at @ at)
    return product / square if product > 0.0 and square > 0.0 else default_s


def _places(
    time_s: Array, place: Array, period_s: float, bounds: Sequence[tuple[int, int]]
) -> Array:
    """Return the nearest places; before a place that is taken already, rows move to earlier ones.

    A stamp can be late but not early.
    """
    found = np.empty(len(time_s))
    for first, end in bounds:
        periods, rows = time_s[first:end] / period_s, np.arange(end - first)
        start = np.median(periods - place[first:end])
        free = np.rint(periods - start) - rows
        found[first:end] = np.minimum.accumulate(free[::-1])[::-1] + rows
    return found


def _rounded(period_s: float, rows: int) -> float:
    """Return the period of the rate with the fewest digits that fits the stamps."""
    for digits in range(1, 12):
        rounded_s = 1.0 / float(f"{1.0 / period_s:.{digits}g}")
        if rows * abs(rounded_s / period_s - 1.0) < _MOST_DRIFT:
            return rounded_s
    return period_s
