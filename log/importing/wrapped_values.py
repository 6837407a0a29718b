"""Unwrap signals that begin again after a range: angles of one turn, counters of n bit."""

from __future__ import annotations

import math
from dataclasses import dataclass

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
_AROUND = 4
"""Rows before and after a jump that show how the signal moves."""
_SAME_WAY = 0.7
"""Least share of jumps at which the signal moves on in the direction in which it came."""


@dataclass(frozen=True)
class Wrap:
    """Jumps of a signal by its range: the range, if it is a usual one, and the rows after jumps.

    estimate: the range as the motion around the jumps gives it. error: its uncertainty.
    """

    range: float | None
    estimate: float
    error: float
    rows: NDArray[np.int64]


def unwrapped(values: Array, wrap_range: float) -> Array:
    """Return values (N,), NaN where missing, without jumps of more than half the range."""
    known = ~np.isnan(values)
    found = values.copy()
    found[known] = np.unwrap(values[known], period=wrap_range)
    return found


def find_wrap(values: Array) -> Wrap | None:
    """Return the jumps of a signal (N,) if they are those of a wrapped one; None for others.

    A wrapped signal jumps by nearly its whole range, always by the same amount once the motion from
    row to row is taken into account, and moves on in its direction: up, a jump down, up again. A
    square wave stands still before and after a jump.
    """
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
    moves_on = bool(np.any(clear)) and np.mean(along[clear] > 0.0) >= _SAME_WAY
    # A signal may also stay around the end of its range; only a usual range tells it from steps.
    dithers = (
        usual is not None
        and 2 * np.count_nonzero(clear) < len(clear)
        and _at_ends(rough, steps[~is_jump], estimate, spread)
    )
    return Wrap(usual, estimate, error, at[jumps + 1]) if moves_on or dithers else None


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


def _at_ends(rough: Array, others: Array, estimate: float, spread: float) -> bool:
    """Return whether a signal jumps from its lowest to its highest value, but for its noise."""
    moved = np.abs(others[others != 0.0])
    if not len(moved):
        return False
    return abs(estimate - spread) <= _TURNS * float(np.median(moved) + np.median(rough))


def _usual_range(estimate: float, error: float, spread: float) -> float | None:
    fits = [
        usual
        for usual in USUAL_RANGES
        if abs(usual - estimate) <= max(error, 1e-3 * usual) and usual >= spread * (1.0 - 1e-6)
    ]
    return min(fits, key=lambda usual: abs(usual - estimate)) if fits else None
