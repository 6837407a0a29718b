"""Find readings that are none: codes for a missing value, spikes, lost decimal points."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter1d, median_filter

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
    candidates, counts = np.unique(values[~found], return_counts=True)
    for code, count in zip(candidates, counts, strict=True):
        if count > _MOST_CODES * len(values) or not _is_code(code):
            continue
        others = candidates[(candidates != code) & ~np.isin(candidates, list(_CODES))]
        if not len(others):
            continue
        spread = float(np.ptp(others))
        distance = float(np.abs(others - code).min())
        if distance > _FAR * spread and (spread > 0.0 or abs(code) > _FAR * np.abs(others).max()):
            found |= values == code
    return found


def _is_code(value: float) -> bool:
    return bool(value in _CODES or np.isclose(value, list(_CODES), rtol=1e-6, atol=0.0).any())


def _spikes(values: Array) -> Mask:
    """Return which values leave the signal for at most five rows, and return to it.

    The height of a spike is its distance from the running median, which follows steps. It must be
    far above noise, and above what the signal moves from row to row nearby.
    """
    height = np.abs(values - median_filter(values, 2 * _LONGEST_SPIKE + 1, mode="nearest"))
    step = np.abs(np.diff(values))
    usual = step[step > 0.0]
    if not len(usual):
        return np.zeros(len(values), bool)
    scale = 1.4826 * float(np.median(usual))
    high = height > _OVER_NOISE * scale
    if not high.any():
        return high
    # Steps into and out of high rows do not count: they are what is judged.
    quiet = np.where(high[1:] | high[:-1], 0.0, step)
    largest = maximum_filter1d(np.concatenate([[0.0], quiet]), 2 * _AROUND + 1, mode="constant")
    found = high & (height > _OVER_STEPS * np.maximum(largest, scale))
    found &= ~_long_runs(found)
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
