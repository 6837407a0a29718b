"""Test an effect on held-out records."""

from __future__ import annotations

from .candidate_screening import HeldError, Tried, is_internal

LOWERS = 0.003
"""Share of their mean square error, simulated freely, that an effect must take."""
_SAME = 1e-6
_COSTS = 0.1
"""Where held-out records do nothing of an effect: of the share that it takes of what the others
show, so much of theirs it may cost, for parameters are fitted anew while others are missing."""


def helps(taken: Tried, error: HeldError, after: HeldError, gone: float, explained: bool) -> bool:
    """Return whether held-out records confirm an effect, by their errors before and after.

    `gone`: the share of what there was to explain that it takes of the others. `explained`: the
    free simulation of the records held out has nothing left to explain. Their errors one step ahead
    have decided then, and it must not become worse.
    """
    if abs(after.squares - error.squares) < _SAME * error.squares:
        return True
    hardly = after.squares < (1.0 + LOWERS) * error.squares
    # What shows in the drives alone leaves the platform's motion as it was, but for parameters
    # that are fitted anew.
    if is_internal(taken.effect):
        return hardly
    if not taken.held:
        costs, left = after.squares - error.squares, error.squares - error.floor
        return hardly or costs < _COSTS * gone * left
    return hardly if explained else after.squares < (1.0 - LOWERS) * error.squares
