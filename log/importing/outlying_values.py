"""Find readings that are none: codes for a missing value, spikes, lost decimal points."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter1d, median_filter, uniform_filter1d

from .gap_filling import runs

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

_LEAST_ROWS = 20
_FAR = 4.0
"""Least distance of a code from the other values, over their whole range."""
_MOST_CODES = 0.5
"""Largest share of rows with a code."""
_LEAST_LEVELS = 3
"""Least number of different values beside a code in a signal that a program sets: of fewer, the
code may be a level, such as 65535 of a pulse width."""
_LONGEST_SPIKE = 5
"""Longest run of rows that leaves the signal and returns to it, in rows."""
_OVER_NOISE = 15.0
"""Least height of a spike over the standard deviation of the change from row to row. A Gaussian
value is beyond 15 standard deviations once in 10^50 rows."""
_OVER_MOTION = 3.0
"""Least height of a spike over the median step in the rows around it."""
_OVER_STEPS = 5.0
"""Least height of a spike over the largest step in the rows around it, as an impact moves the
signal in the rows after it as well; of one that is certain, over all other steps of the record."""
_FLAT = 0.2
"""Largest change inside a spike of several rows, over its height: an impact rises and falls."""
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
class Spikes:
    """Rows (N,) of a column that leave the signal for a few rows and return to it.

    certain: no other step of the record is nearly as high. doubtful: the signal also jumps
    elsewhere, or it rises and falls within the rows, as an impact does.
    """

    certain: Mask
    doubtful: Mask


def find_codes(values: Array, *, levels: bool) -> Mask:
    """Return which values (N,), NaN where missing, are codes for no reading.

    They are impossibly large, or a usual code far from all other values. levels: whether the signal
    may consist of a few levels, as one that a program sets.
    """
    found = np.zeros(len(values), bool)
    known = ~np.isnan(values)
    found[known] = _codes(values[known], 1 + levels * (_LEAST_LEVELS - 1))
    return found


def lone_level(values: Array) -> float | None:
    """Return a value far from all others of a signal (N,) at which it rests in several rows.

    None without one. It may be a lost reading, such as 0, or a level.
    """
    known = values[~np.isnan(values)]
    for level in (np.min(known, initial=np.inf), np.max(known, initial=-np.inf)):
        others = known[known != level]
        rows = len(known) - len(others)
        if not _LONGEST_SPIKE < rows <= _MOST_CODES * len(known):
            continue
        far = float(np.min(np.abs(others - level))) > _FAR * float(np.ptp(others))
        if far and len(np.unique(others)) >= _LEAST_LEVELS:
            return float(level)
    return None


def _codes(values: Array, least_others: int) -> Mask:
    found = np.abs(values) >= _LARGEST
    near = {code: np.abs(values - code) <= 1e-6 * abs(code) for code in _CODES}
    near = {code: mask for code, mask in near.items() if mask.any()}
    if not near:
        return found
    others = values[~(found | np.any(list(near.values()), axis=0))]
    if len(np.unique(others)) < least_others:
        return found
    spread, largest = float(np.ptp(others)), float(np.abs(others).max())
    for code, mask in near.items():
        far = min(abs(code - others.min()), abs(code - others.max())) > _FAR * spread
        inside = others.min() < code < others.max()
        apart = spread > 0.0 or abs(code) > _FAR * largest
        if far and not inside and apart and np.count_nonzero(mask) <= _MOST_CODES * len(values):
            found |= mask
    return found


def find_spikes(values: Array) -> Spikes:
    """Return which values (N,), NaN where missing, leave the signal for at most five rows.

    The height of a spike is its distance from the running median, which follows steps. It must be
    far above noise, and above what the signal moves from row to row nearby, or over its whole
    range. The first and the last row count only beyond the range of all others.
    """
    certain, doubtful = np.zeros(len(values), bool), np.zeros(len(values), bool)
    known = ~np.isnan(values)
    if np.count_nonzero(known) >= _LEAST_ROWS:
        certain[known], doubtful[known] = _spikes(values[known])
    return Spikes(certain, doubtful)


def _spikes(values: Array) -> tuple[Mask, Mask]:
    none = np.zeros(len(values), bool)
    height = np.abs(values - median_filter(values, 2 * _LONGEST_SPIKE + 1, mode="mirror"))
    step = np.abs(np.diff(values))
    if not step.any():
        return none, none
    # The change of the step is noise; the step itself is motion as well.
    noise = 1.4826 * float(np.median(np.abs(np.diff(values, 2)))) / np.sqrt(3.0)
    scale = max(noise, float(np.min(step[step > 0.0])))
    motion = np.append(0.0, median_filter(step, 2 * _AROUND + 1, mode="mirror"))
    high = height > np.maximum(_OVER_NOISE * scale, _OVER_MOTION * motion)
    for begin, end in runs(high):
        high[begin:end] = end - begin <= _LONGEST_SPIKE
    # Steps into and out of high rows do not count: they are what is judged.
    largest = maximum_filter1d(_steps_between(step, ~high), 2 * _AROUND + 1, mode="constant")
    begins = np.diff(high.astype(np.int64), prepend=0) == 1
    width = 2 * _AROUND + 1
    near = uniform_filter1d(begins.astype(np.float64), width, mode="constant") * width
    alone = (height > _OVER_STEPS * np.maximum(largest, scale)) & (near < _MOST_NEAR)
    found = high & (alone | (height > float(np.ptp(values[~high]))))
    for begin, end in runs(found):
        at_edge = begin == 0 or end == len(values)
        beyond = end - begin == 1 and height[begin] > np.ptp(values[~found])
        found[begin:end] = not at_edge or beyond
    if np.count_nonzero(found) > _MOST_SPIKES * len(values):
        return none, none
    # If nothing else moves the signal, the spikes are the signal.
    others = float(_steps_between(step, ~found).max())
    certain = found & (height > _OVER_STEPS * others) & (others > 0.0)
    for begin, end in runs(found):
        flat = np.ptp(values[begin:end]) < _FLAT * height[begin:end].min()
        certain[begin:end] &= certain[begin:end].all() and flat
    return certain, found & ~certain


def _steps_between(step: Array, rows: Mask) -> Array:
    """Return the step (N,) before each row, 0 unless it and the row before are among `rows`."""
    return np.concatenate([[0.0], np.where(rows[1:] & rows[:-1], step, 0.0)])
