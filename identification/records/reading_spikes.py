"""Find readings that stand out of their neighbours, and interpolate them.

One wrong reading of a sensor - a bit error, a lost decimal point, an electric discharge - has more
energy than all motion in a record, so a least-squares fit follows it. A plant with inertia cannot
leave its path for a few rows and return to it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import median_filter

Array = NDArray[np.float64]

FAR = 20.0
"""Distance from the median of the neighbours, in standard deviations of all such distances, from
which a reading is a spike. Noise with a normal distribution reaches 6 in a billion rows; a smaller
spike adds less than a per cent to the squared errors of a record of 40,000 rows."""
_WINDOW, _LONGEST = 7, 3
"""Rows of the median, and of the longest spike, which the median rejects."""
_AROUND = 51
"""Rows from which the usual distance is taken: an impact is quick, but its motion goes on."""
_DEVIATION = 1.4826
"""Standard deviation of normally distributed values over the median of their sizes."""
_MOST = 0.02
"""Largest share of rows that are spikes: more are no errors of single readings."""


@dataclass(frozen=True)
class Spikes:
    """An output without its spikes (N,), their rows, and how far the farthest one stood out.

    largest: distance from the neighbours over the usual distance.
    """

    values: Array
    rows: tuple[int, ...] = ()
    largest: float = 0.0

    def remark(self, name: str, Ts_s: float) -> str | None:
        """Return what was found in the output `name`; None without a spike."""
        if not self.rows:
            return None
        count = len(self.rows)
        at = ", ".join(f"{row} ({row * Ts_s:.4g} s)" for row in self.rows[:3])
        more = f" and {count - 3} more" if count > 3 else ""
        return (
            f"{name}: {count} reading{'s' * (count > 1)} stand{'s' * (count == 1)} out of "
            f"{'their' if count > 1 else 'its'} neighbours, up to {self.largest:.2g} times the "
            f"usual distance: row{'s' * (count > 1)} {at}{more}. Interpolated values replace "
            "them in all fits. Check the sensor's connection; mask such rows in the data if they "
            "are known"
        )


def without_spikes(y: Array, inputs: Array) -> Spikes:
    """Return an output (N,) with interpolated values in place of its spikes.

    A spike lasts up to three rows, and the readings before and after it agree. Where an input
    (N, p) has a spike in the same rows, the output may answer to it.
    """
    rows = len(y)
    if rows < _AROUND or not np.ptp(y):
        return Spikes(y)
    far = _distance(y)
    found = far > FAR
    for column in inputs.T:
        found &= ~_near(_distance(column) > FAR)
    spikes = [
        (first, stop)
        for first, stop in _runs(found)
        if first > 0 and stop < rows and stop - first <= _LONGEST and _returns(y, first, stop)
    ]
    numbers = [row for first, stop in spikes for row in range(first, stop)]
    if not numbers or len(numbers) > max(_MOST * rows, _LONGEST):
        return Spikes(y)
    kept = np.setdiff1d(np.arange(rows), numbers)
    values = y.copy()
    values[numbers] = np.interp(numbers, kept, y[kept])
    return Spikes(values, tuple(numbers), float(far[numbers].max()))


def _distance(y: Array) -> Array:
    """Return the distance of each value (N,) from the median of its neighbours, over the usual
    distance in the record and around it."""
    size = float(np.abs(y).max())
    unit = y / size if size > 0.0 else y
    apart = np.abs(unit - median_filter(unit, _WINDOW, mode="nearest"))
    changes = np.abs(np.diff(unit))
    # The step of a coarse reading: most of its rows may not change at all.
    step = float(np.min(changes[changes > 0.0], initial=np.inf))
    usual = np.maximum(float(np.median(apart)), median_filter(apart, _AROUND, mode="nearest"))
    floor = step if np.isfinite(step) else 1.0
    whole = float(np.median(changes))
    return np.asarray(apart / (_DEVIATION * np.maximum(usual, max(whole, floor) / 2.0)))


def _near(found: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return the rows that are at most a window from a found one."""
    return np.asarray(np.convolve(found, np.ones(2 * _WINDOW + 1), mode="same") > 0.5)


def _runs(found: NDArray[np.bool_]) -> list[tuple[int, int]]:
    edges = np.flatnonzero(np.diff(np.concatenate([[0], found.astype(np.int8), [0]])))
    return list(zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True))


def _returns(y: Array, first: int, stop: int) -> bool:
    """Return whether the readings before and after a spike are closer to each other than to it."""
    before, after = y[first - 1], y[stop]
    apart = min(np.abs(y[first:stop] - before).min(), np.abs(y[first:stop] - after).min())
    return bool(np.abs(before - after) < 0.5 * apart)
