"""Round forces to the steps of a bus, and carry the rounding error into the next cycle."""

from __future__ import annotations

import numpy as np
from numba import njit

from .base import Array


class ForceQuantiser:
    """Rounds commands (C,) to steps with first-order error feedback (noise shaping).

    Plain rounding of a slowly changing force has a constant error, which matters near a resonance.
    With feedback the mean force is exact, and the error is at high frequencies. Zero stays zero.
    """

    def __init__(self, step: float, channels: int) -> None:
        self._step = step
        self._rest, self._out = np.zeros(channels), np.zeros(channels)
        self(self._rest)  # compile before the first cycle

    def __call__(self, values: Array) -> Array:
        """Return `values` (C,) in whole steps; the next call overwrites the array."""
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
