"""Forces on a wire of whole steps: what is rounded off in one cycle is made up for in the next."""

from __future__ import annotations

import numpy as np
from numba import njit

from .base import Array


class CarriedRounding:
    """Rounds commands (C,) to steps; the rests go into the next cycle's, so that none is lost.

    Plain rounding of a force that hardly changes is off by the same part of a step for a long time,
    and near a resonance that is not little. Carried on, the mean force is right, and what is left
    is as fast as the cycle. Zero force is zero.
    """

    def __init__(self, step: float, channels: int) -> None:
        self._step = step
        self._rest, self._out = np.zeros(channels), np.zeros(channels)
        self(self._rest)  # compiled here, not in a cycle

    def __call__(self, values: Array) -> Array:
        """Return `values` in whole steps; the array is overwritten by the next call."""
        _round(values, self._step, self._rest, self._out)
        return self._out


@njit(cache=True)
def _round(values, step, rest, out) -> None:  # type: ignore[no-untyped-def]
    for i in range(values.size):
        wanted = values[i] + rest[i]
        if values[i] == 0.0 or not np.isfinite(wanted):
            out[i] = values[i]
            rest[i] = 0.0
        else:
            out[i] = np.rint(wanted / step) * step
            rest[i] = wanted - out[i]
