"""Whether records that fitted nothing agree that an effect is there."""

from __future__ import annotations

from .screening import HeldError, Tried, is_internal

_LOWERS = 0.003
"""Share of their mean square error, simulated freely, that an effect must take."""
_SAME = 1e-6
_COSTS = 0.1
"""Where held-out records do nothing of an effect: of the share that it takes of what the others
show, so much of theirs it may cost, for parameters are fitted anew while others are missing."""


def helps(taken: Tried, error: HeldError, after: HeldError, gone: float, explained: bool) -> bool:
    """Return whether held-out records agree, by their errors before and after it was taken.

    `gone`: the share of what there was to explain that it takes of the others. `explained`: there
    is nothing to explain in the records held out.
    """
    costs, little = after.squares - error.squares, _LOWERS * error.squares
    if abs(costs) < _SAME * error.squares:
        return True
    # What shows in the drives alone leaves the platform's motion as it was, but for parameters
    # that are fitted anew.
    if is_internal(taken.effect):
        return costs < little
    if not taken.held:
        return costs < max(_COSTS * gone * (error.squares - error.floor), little)
    return not explained and costs < -little
