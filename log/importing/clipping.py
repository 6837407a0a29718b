"""Detect signals that rest at their highest or lowest value, as a clipped signal does."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_BINS = 200
_LEAST_SHARE = 0.005
_LEAST_ROWS = 10
_NEIGHBOURS = 5
_RATIO = 5.0
"""Least ratio of the rows in the outermost bin to the mean of its neighbours. A sine has 3.4, a
Gaussian signal clipped at two standard deviations 20."""
_LEAST_LEVELS = 20
"""Least number of bins between the extremes with values. Steps and binary signals have fewer: they
rest at levels that are meant."""
_MOSTLY = 0.5
"""Share of the rows away from a level that repeat the row before in a signal of steps. A signal of
few bits repeats some, but not most."""
_STEP, _HALTED = 2, 0.5
"""A reading is cut off in the middle of a motion: before it rests at a level and after it, it
changes by half of what it does in the mean, at least. That is measured over a time in which it
changes by so many bins; noise changes it by less. A move that ends at rest, or begins there, is
slow."""


@dataclass(frozen=True)
class ClippedLevel:
    """A level at which a signal rests: its value, the share of rows there, its side."""

    level: float
    share: float
    side: str


def clipped_levels(values: Array, *, halted: bool = False) -> list[ClippedLevel]:
    """Return the extreme levels at which a signal (N,) rests; NaN counts as missing.

    The histogram decides: far more rows in the outermost bin, 0.5 % of the range, than in the bins
    beside it. Rows at rest before the signal starts and after it ends do not count. halted: only
    levels at which it arrives in full motion.
    """
    values = _trimmed(values[~np.isnan(values)])
    if len(values) < _LEAST_ROWS or np.ptp(values) == 0.0:
        return []
    counts, _ = np.histogram(values, _BINS)
    if np.count_nonzero(counts[1:-1]) < _LEAST_LEVELS:
        return []
    found = []
    bin_width = float(np.ptp(values)) / _BINS
    for side, level, ordered in (
        ("highest", float(values.max()), counts[::-1]),
        ("lowest", float(values.min()), counts),
    ):
        rows, others = int(ordered[0]), ordered[1:]
        # Coarsely quantised values leave bins empty.
        beside = float(np.mean(others[others > 0][:_NEIGHBOURS]))
        if rows < max(_LEAST_ROWS, _LEAST_SHARE * len(values)) or rows <= _RATIO * beside:
            continue
        at_level = np.abs(values - level) < bin_width
        if _rests_elsewhere(values, at_level):
            continue
        if not halted or _in_full_motion(values, at_level, _STEP * bin_width):
            found.append(ClippedLevel(level, rows / len(values), side))
    return found


def clipping_remarks(name: str, unit: str, values: Array, *, output: bool) -> list[str]:
    """Return a remark for each level at which an input or output (N,) rests."""
    number = "" if unit == "1" else f" {unit}"

    def cost(percent: str) -> str:
        # A Gaussian signal that is clipped in a share of its rows keeps the rest of its covariance
        # with other signals (Bussgang, 1952). For a clipped input the gain rises by nearly the same
        # share: 3.7 % for 4.6 %, 32 % for 32 %.
        if output:
            return (
                "if the sensor is at the end of its range there, or the motion at a stop, the "
                f"model is biased: gains are about {percent} too small. Leave these rows out (key "
                "rows)"
            )
        return (
            "harmless if this level is intended or an amplifier limits it; if only the "
            f"measurement is clipped, the true input is larger, and gains are about {percent} too "
            "large: repeat with less excitation"
        )

    return [
        f"{name} rests at its {found.side} value, {found.level:.4g}{number}, in "
        f"{100 * found.share:.2g} % of the rows: {cost(f'{100 * found.share:.2g} %')}"
        for found in clipped_levels(values, halted=output)
    ]


def _rests_elsewhere(values: Array, at_level: NDArray[np.bool_]) -> bool:
    """Return whether values are held for rows at other levels too, as steps of many sizes are."""
    held = (values[1:] == values[:-1]) & ~at_level[1:]
    return bool(np.count_nonzero(held) > _MOSTLY * np.count_nonzero(~at_level[1:]))


def _in_full_motion(values: Array, at_level: NDArray[np.bool_], change: float) -> bool:
    """Return whether values arrive at a level, and leave it, about as fast as they move elsewhere.

    What begins at rest at a level never arrives there, and what ends at rest does not leave it.
    """
    lag = 1
    while lag < len(values) // 2 and _rms(values[lag:] - values[:-lag]) < change:
        lag *= 2
    changes = np.abs(values[lag:] - values[:-lag])
    arrives = np.flatnonzero(~at_level[:-1] & at_level[1:]) + 1 - lag
    leaves = np.flatnonzero(at_level[:-1] & ~at_level[1:])
    steps = [changes[arrives[arrives >= 0]], changes[leaves[leaves < len(changes)]]]
    slowest = min(np.median(each) if len(each) else 0.0 for each in steps)
    return bool(slowest > _HALTED * _rms(changes))


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _trimmed(values: Array) -> Array:
    """Return the values without rows at rest at the beginning and at the end."""
    if not len(values):
        return values
    moving = np.flatnonzero(values[1:] != values[:-1])
    return values[moving[0] : moving[-1] + 2] if len(moving) else values[:1]
