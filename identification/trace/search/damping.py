"""Damp steps as Levenberg and Marquardt do: less after one that helped, more after another."""

from __future__ import annotations

from ..search_options import SearchOptions

_FIRST, MOST_DAMPING = SearchOptions.accuracy, 1.0 / SearchOptions().inexact
"""Damping of the first shorter step, and beyond which a step is none, over the squares' slope."""
_FACTOR = 1.0 / SearchOptions.least_gain
"""Marquardt's own factor between two dampings."""


def less(damping: float, failed: bool) -> float:
    """Return the damping after a step that helped; none below the first one.

    Where a longer one has just `failed` it would again, and the next is as short.
    """
    if failed:
        return damping
    return damping / _FACTOR if damping > _FIRST else 0.0


def more(damping: float) -> float:
    """Return the damping after a step that did not help."""
    return max(_FACTOR * damping, _FIRST)
