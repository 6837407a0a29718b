"""Find readings that are none: codes for a missing value, spikes, lost decimal points."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter1d, median_filter, uniform_filter1d

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

_LEAST_ROWS = 20
_FAR = 4.0
"""Least distance of a code from the other values, over their whole range."""
_MOST_CODES = 0.5
"""Largest share of rows with a code."""
_LONGEST_SPIKE = 5
"""Longest run of rows that leaves the signal and returns to it, in rows."""
_OVER_NOISE = 15.0
"""Least height of a spike over the standard deviation of the change from row to row. A Gaussian
value is beyond 15 standard deviations once in 10^50 rows."""
_OVER_STEPS = 5.0
"""Least height of a spike over the largest step in the rows around it. An impact moves the signal
in the rows after it as well."""
_AROUND = 25
"""Rows before and after a spike in which its height is compared with other steps."""
_MOST_NEAR = 5.5
"""Most spikes in the rows around one: more are an oscillation."""
_MOST_SPIKES = 0.02
"""Largest share of rows in spikes: more of them belong to the signal."""
_CODES = frozenset(
    {
        *(-99.0, -999.0, -9999.0, -99999.0, -999999.0, -999.25, -9999.25, -999.9, -9999.9),
        *(999.0, 9999.0, 99999.0, 999999.0, 999.25, -32768.0, 32767.0, -8388608.0, 8388607.0),
        *(65535.0, 16777215.0, 4294967295.0, 2147483647.0, -2147483648.0, 9.223372036854775807e18),
        *(-9.223372036854775808e18, 9.9e37, -9.9e37, 9.91e37, 1e30, -1e30, 1e31, -1e31, 1e37),
        *(-1e34, 1e35, 1e36, 1e20, -1e20, 9.96921e36),
    }
)
"""Numbers that instruments and programs write for a missing, invalid or overloaded reading."""
_LARGEST = 1e30
"""Magnitude above which no reading in a usual unit is one: near the end of a float32."""


@dataclass(frozen=True)
class Outliers:
    """Rows (N,) of a column whose values are no readings, and why.

    codes: which rows hold a code for a missing value. spikes: which rows leave the signal for a
    few rows.
    """

    codes: Mask
    spikes: Mask

    @property
    def rows(self) -> NDArray[np.int64]:
        """Indices of the rows."""
        return np.flatnonzero(self.codes | self.spikes)


def find_outliers(values: Array, *, sudden: bool) -> Outliers:
    """Return the values (N,), NaN where missing, that are no readings of this signal.

    sudden: the signal may change suddenly, as inputs and references do: then only codes for
    missing values count.
    """
    known = ~np.isnan(values)
    codes, spikes = np.zeros(len(values), bool), np.zeros(len(values), bool)
    codes[known] = _codes(values[known])
    rest = known & ~codes
    if not sudden and np.count_nonzero(rest) >= _LEAST_ROWS:
        spikes[rest] = _spikes(values[rest])
    return Outliers(codes, spikes)


def lone_extremes(values: Array) -> NDArray[np.int64]:
    """Return rows of a signal (N,) that may change suddenly, with a value far beyond all others."""
    known = np.flatnonzero(~np.isnan(values))
    if len(known) < _LEAST_ROWS:
        return known[:0]
    ordered = np.sort(values[known])
    kept = ordered[2:-2]
    spread = float(np.ptp(kept))
    if spread == 0.0:
        return known[:0]
    far = np.abs(values[known] - np.median(kept)) > _OVER_NOISE * spread
    return known[far]


def _codes(values: Array) -> Mask:
    """Return which values are codes: far from all others, and a usual code or impossibly large."""
    found = np.abs(values) >= _LARGEST
    near = {code: np.abs(values - code) <= 1e-6 * abs(code) for code in _CODES}
    near = {code: mask for code, mask in near.items() if mask.any()}
    if not near:
        return found
    others = values[~(found | np.any(list(near.values()), axis=0))]
    if not len(others):
        return found
    spread, largest = float(np.ptp(others)), float(np.abs(others).max())
    for code, mask in near.items():
        far = min(abs(code - others.min()), abs(code - others.max())) > _FAR * spread
        inside = others.min() < code < others.max()
        apart = spread > 0.0 or abs(code) > _FAR * largest
        if far and not inside and apart and np.count_nonzero(mask) <= _MOST_CODES * len(values):
            found |= mask
    return found


def _spikes(values: Array) -> Mask:
    """Return which values leave the signal for at most five rows, and return to it.

    The height of a spike is its distance from the running median, which follows steps. It must be
    far above noise, and above what the signal moves from row to row nearby.
    """
    height = np.abs(values - median_filter(values, 2 * _LONGEST_SPIKE + 1, mode="mirror"))
    step = np.abs(np.diff(values))
    usual = step[step > 0.0]
    if not len(usual):
        return np.zeros(len(values), bool)
    scale = 1.4826 * float(np.median(usual))
    high = height > _OVER_NOISE * scale
    if not high.any():
        return high
    high &= ~_long_runs(high)
    # Steps into and out of high rows do not count: they are what is judged.
    quiet = np.where(high[1:] | high[:-1], 0.0, step)
    width = 2 * _AROUND + 1
    largest = maximum_filter1d(np.concatenate([[0.0], quiet]), width, mode="constant")
    begins = np.diff(np.concatenate([[0], high.astype(np.int64)])) == 1
    near = uniform_filter1d(begins.astype(np.float64), width, mode="constant") * width
    found = high & (height > _OVER_STEPS * np.maximum(largest, scale)) & (near < _MOST_NEAR)
    if np.count_nonzero(found) > _MOST_SPIKES * len(values):
        return np.zeros(len(values), bool)
    return found


def _long_runs(mask: Mask) -> Mask:
    """Return the rows (N,) in runs of more rows than a spike has."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], mask.astype(np.int8), [0]])))
    found = np.zeros(len(mask), bool)
    for begin, end in edges.reshape(-1, 2):
        found[begin:end] = end - begin > _LONGEST_SPIKE
    return found
