"""Damp steps as Levenberg and Marquardt do: less after one that helped, more after another."""

from __future__ import annotations

from ..search_options import SearchOptions

_FIRST, MOST_DAMPING = SearchOptions.accuracy, 1.0 / SearchOptions().inexact
"""Damping of the first shorter step, and beyond which a step is none, over the squares' slope."""
_FACTOR = float(SearchOptions.resolved)


def less(damping: float) -> float:
    """Return the damping after a step that helped; none below the first one."""
    return damping / _FACTOR if damping > _FIRST else 0.0


def more(damping: float) -> float:
    """Return the damping after a step that did not help."""
    return max(_FACTOR * damping, _FIRST)
