"""Collect the figures of written pages that could not be drawn; imports no matplotlib."""

from __future__ import annotations

undrawn_figures: list[str] = []
"""File and reason of each, since the start of this process or since they were taken."""


def take_undrawn_figures() -> list[str]:
    """Return the collected figures and forget them."""
    found = list(undrawn_figures)
    undrawn_figures.clear()
    return found
