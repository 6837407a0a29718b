"""Unwrap signals that begin again after a range: angles of one turn, counters of n bit."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

USUAL_RANGES = (
    *(2.0**bits for bits in range(8, 65)),
    *(1.0, math.pi, 2.0 * math.pi, 180.0, 360.0, 400.0, 21600.0, 1296000.0),
    *(factor * 10.0**digits for digits in range(2, 8) for factor in (1.0, 2.0, 2.5, 3.6, 4.0, 8.0)),
)
"""Ranges of counters and angles: n bit, a turn in rad, deg, gon, arc minutes, arc seconds, and the
counts of usual encoders."""
_LEAST_JUMP = 0.6
"""Smallest jump of a wrapped signal over its range: it moves by less than that between two rows."""
_NEAR = 0.02
"""Largest relative difference between the ranges that the jumps give."""
_MOST_SHARE = 0.45
"""Largest share of rows with a jump."""
_LEAST_VALUES = 6
"""Least number of different values: a signal of few levels jumps by design."""
_TURNS = 4.0
"""Most motion over a jump, in those of the rows around it."""
_LONGEST_EXCURSION = 5
"""Most rows of values that leave a signal and return to it."""
_LEAST_AT_ENDS = 6
"""Least number of rows in the lowest and highest fifth of a signal that stays around its end."""
_AROUND = 4
"""Rows before and after a jump that show how the signal moves."""
_SAME_WAY = 0.7
"""Least share of jumps at which the signal moves on in the direction in which it came."""


@dataclass(frozen=True)
class Wrap:
    """Jumps of a signal by its range: the range, if it is a usual one, and the rows after jumps.

    estimate: the range as the motion around the jumps gives it. error: its uncertainty. apart (N,):
    rows that left the signal for a few rows and had to be left out to find the jumps.
    """

    range: float | None
    estimate: float
    error: float
    rows: NDArray[np.int64]
    apart: NDArray[np.bool_]


def unwrapped(values: Array, wrap_range: float, apart: NDArray[np.bool_]) -> Array:
    """Return values (N,), NaN where missing, without jumps of more than half the range.

    apart (N,): rows that may be no readings. They turn no other row; those beyond the range of
    the others are put far away, where they are outliers.
    """
    known = ~np.isnan(values)
    usual = np.flatnonzero(known & ~apart)
    found = values.copy()
    if len(usual) < 2:
        return found
    steps, rows = np.diff(values[usual]), np.diff(usual)
    moved = steps - wrap_range * np.round(steps / wrap_range)
    for gap in np.flatnonzero(rows > 1):
        # A fast angle moves by more than half the range over missing rows.
        beside = [moved[i] for i in (gap - 1, gap + 1) if 0 <= i < len(rows) and rows[i] == 1]
        expected = rows[gap] * np.mean(beside or [0.0])
        moved[gap] = steps[gap] + wrap_range * np.round((expected - steps[gap]) / wrap_range)
    found[usual[1:]] = values[usual[0]] + np.cumsum(moved)
    other = np.flatnonzero(known & apart)
    near = np.interp(other, usual, found[usual])
    found[other] += wrap_range * np.round((near - found[other]) / wrap_range)
    beyond = (values[other] < np.min(values[usual])) | (values[other] > np.max(values[usual]))
    found[other[beyond]] = np.max(found[usual]) + 10.0 * np.ptp(found[usual])
    return found


def find_wrap(values: Array) -> Wrap | None:
    """Return the jumps of a signal (N,) if they are those of a wrapped one; None for others.

    A wrapped signal jumps by nearly its whole range, always by the same amount once the motion from
    row to row is taken into account, and moves on in its direction: up, a jump down, up again. A
    square wave stands still before and after a jump. If there are wrong values as well, the jumps
    are those that remain without all values that leave the signal and return to it.
    """
    found = _find_wrap(values, np.zeros(len(values), bool))
    if (found is not None and found.range is not None) or np.isnan(values).all():
        return found
    low, high = np.nanquantile(values, [0.01, 0.99])
    far = np.abs(values - 0.5 * (low + high)) > high - low
    for apart in (far, far | excursions(values)):
        again = _find_wrap(np.where(apart, np.nan, values), apart) if apart.any() else None
        if again is not None and again.range is not None:
            others = values[~apart & ~np.isnan(values)]
            beyond = (values < others.min()) | (values > others.max())
            # A fast angle returns to a value in a few rows, but not as an angle.
            return replace(again, apart=apart & (beyond | excursions(values, again.range)))
        found = found or again
    return found


def excursions(values: Array, wrap_range: float | None = None) -> NDArray[np.bool_]:
    """Return rows (N,) that differ by a tenth of the range from those before and after them.

    wrap_range: differences are those of angles, and above the usual motion, as a fast angle is
    where it was after some rows; without it, the range is that of the values.
    """
    at = np.flatnonzero(~np.isnan(values))
    known = values[at]
    found = np.zeros(len(values), bool)
    if len(known) < 2:
        return found
    spread = wrap_range or float(np.ptp(np.quantile(known, [0.01, 0.99])))

    def difference(a: Array, b: Array) -> Array:
        turns = 0.0 if wrap_range is None else wrap_range * np.round((a - b) / wrap_range)
        return np.asarray(np.abs(a - b - turns))

    least = 0.1 * spread
    if wrap_range is not None:
        least = max(least, _TURNS * float(np.median(difference(known[1:], known[:-1]))))
    for length in range(1, min(_LONGEST_EXCURSION, len(known) - 2) + 1):
        before, after = known[: -length - 1], known[length + 1 :]
        inside = [known[1 + i : len(known) - length + i] for i in range(length)]
        height = np.min([difference(value, before) for value in inside], axis=0)
        returns = difference(after, before) < 0.25 * height
        begins = np.flatnonzero((height > least) & returns)
        for i in range(length):
            found[at[begins + 1 + i]] = True
    return found


def _find_wrap(values: Array, apart: NDArray[np.bool_]) -> Wrap | None:
    at = np.flatnonzero(~np.isnan(values))
    known = values[at]
    if len(known) < 3 * _AROUND or len(np.unique(known)) < _LEAST_VALUES:
        return None
    steps, spread = np.diff(known), float(np.ptp(known))
    jumps = np.flatnonzero(np.abs(steps) > _LEAST_JUMP * spread)
    jumps = jumps[(jumps > 0) & (jumps < len(steps) - 1)]  # a wrong value at an end jumps as well
    if not len(jumps) or len(jumps) > _MOST_SHARE * len(known):
        return None
    is_jump = np.zeros(len(steps), bool)
    is_jump[jumps] = True
    motion, rough = _motion(steps, is_jump, jumps)
    sign = -np.sign(steps[jumps])
    ranges = np.abs(steps[jumps]) + sign * motion
    estimate = float(np.median(ranges))
    usual_error = float(np.median(rough))
    limit = np.maximum(_TURNS * rough, _NEAR * estimate)
    if np.any(np.abs(ranges - estimate) > limit) or usual_error > 0.2 * estimate:
        return None
    error = float(np.max(np.abs(ranges - estimate)) + usual_error) + 1e-9 * estimate
    usual = _usual_range(estimate, error, spread)
    along = sign * motion
    clear = np.abs(along) > rough
    # A spike jumps and jumps back.
    stays = np.diff(jumps, append=len(steps)) > _LONGEST_EXCURSION
    stays |= np.append(sign[:-1] == sign[1:], True)
    moves_on = bool(np.any(clear & stays)) and np.mean(along[clear] > 0.0) >= _SAME_WAY
    # A signal may also stay around the end of its range; only a usual range tells it from steps.
    dithers = (
        usual is not None
        and 2 * np.count_nonzero(clear) < len(clear)
        and _at_ends(known, rough, steps[~is_jump], estimate)
    )
    if not (moves_on or dithers):
        return None
    return Wrap(usual, estimate, error, at[jumps + 1], apart)


def _motion(
    steps: Array, is_jump: NDArray[np.bool_], jumps: NDArray[np.int64]
) -> tuple[Array, Array]:
    """Return the motion per row around each jump, and its uncertainty."""
    motion, rough = np.zeros(len(jumps)), np.zeros(len(jumps))
    for number, jump in enumerate(jumps):
        near = np.arange(max(jump - _AROUND, 0), min(jump + _AROUND + 1, len(steps)))
        near = near[~is_jump[near]]
        if len(near):
            motion[number] = np.median(steps[near])
            rough[number] = np.max(np.abs(steps[near] - motion[number]))
    return motion, rough


def _at_ends(known: Array, rough: Array, others: Array, estimate: float) -> bool:
    """Return whether a signal is at both its ends, and jumps between them but for its noise."""
    moved, spread = np.abs(others[others != 0.0]), float(np.ptp(known))
    low = np.count_nonzero(known < known.min() + 0.2 * spread)
    high = np.count_nonzero(known > known.max() - 0.2 * spread)
    if not len(moved) or min(low, high) < _LEAST_AT_ENDS:
        return False
    return abs(estimate - spread) <= _TURNS * float(np.median(moved) + np.median(rough))


def _usual_range(estimate: float, error: float, spread: float) -> float | None:
    fits = [
        usual
        for usual in USUAL_RANGES
        if abs(usual - estimate) <= max(error, 1e-3 * usual) and usual >= spread * (1.0 - 1e-6)
    ]
    return min(fits, key=lambda usual: abs(usual - estimate)) if fits else None
