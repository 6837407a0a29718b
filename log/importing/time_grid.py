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
_MOST_RESOLUTION = 2.0
"""Coarsest resolution of stamps that is recognised, in periods."""
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


def fit_grid(where: str, time_s: Array, row: Index) -> TimeGrid:
    """Fit a uniform grid to time stamps (N,) in s; `row` (N,) are their rows in the file.

    A stamp may be late, which delays only itself and the few rows behind it; a missing row delays
    all rows after it.

    Raises:
        LogError: fewer than three stamps, or stamps that do not increase.
    """
    if len(time_s) < _MIN_ROWS:
        raise LogError(f"{where}: expected at least {_MIN_ROWS} times, found {len(time_s)}")
    time_s = time_s - time_s[0]
    steps = np.diff(time_s)
    rough_s = _rough_period(time_s)
    resolution_s = _resolution(time_s, rough_s) if rough_s > 0.0 else 0.0
    _check_order(where, time_s, row, equal_allowed=resolution_s > 0.5 * rough_s > 0.0)
    cuts = np.flatnonzero(steps > (LONGEST_FILLED_ROWS + 1.5) * rough_s) + 1
    edges = [0, *cuts.tolist(), len(time_s)]
    bounds = list(pairwise(edges))
    # Rounded steps count periods; the sum is right even if a late stamp makes one step too long.
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


def _check_order(where: str, time_s: Array, row: Index, *, equal_allowed: bool) -> None:
    steps = np.diff(time_s)
    wrong = np.flatnonzero(steps < 0.0 if equal_allowed else steps <= 0.0)
    if not len(wrong):
        return
    before, after = row[wrong[0]], row[wrong[0] + 1]
    step_s = steps[wrong[0]]
    if step_s == 0.0:
        found = (
            f"the same time in rows {before} and {after}; delete one of these rows, or, if the "
            "stamps are those of blocks of rows, set rate_hz and give the time the role other"
        )
    else:
        found = (
            f"a step back by {-step_s:.6g} s from row {before} to {after}; sort the rows, or "
            "import those before and after it separately (key rows)"
        )
    raise LogError(f"{where}: expected times that increase from row to row, found {found}")


def _rough_period(time_s: Array) -> float:
    """Return the median step over windows: rounded stamps and a few gaps do not matter."""
    rows = min(_WINDOW_ROWS, len(time_s) - 1)
    return float(np.median(time_s[rows:] - time_s[:-rows])) / rows


def _resolution(time_s: Array, period_s: float) -> float:
    """Return the largest power of ten in s of which all stamps are multiples; 0 if negligible."""
    coarsest = np.floor(np.log10(_MOST_RESOLUTION * period_s))
    for step_s in 10.0 ** np.arange(coarsest, coarsest - 3.0, -1.0):
        if step_s < 0.01 * period_s:
            return 0.0
        multiples = time_s / step_s
        if np.abs(multiples - np.rint(multiples)).max() < 1e-3:
            return float(step_s)
    return 0.0


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
