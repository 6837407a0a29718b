"""Find where a DOF rests: its speed is not told from zero for longer than a low-pass remembers."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation, binary_opening

Array = NDArray[np.float64]

_SURELY = 5.0
"""Standard deviations of its noise that a speed exceeds once in two million rows."""


def moving_rows(
    speed: Array, sd: Array, Ts_s: float, speed_hz: float, memory_s: float
) -> NDArray[np.bool_]:
    """Return where each DOF moves (N, n).

    speed (N, n): per s, below `speed_hz`, of outputs with white noise of deviation sd (n,).
    memory_s: memory of the low-pass of the force balance. A rest is longer than that, a turn is
    not; rows within half of it of a rest count as rest. A DOF that moves in no row is taken to move
    in all.
    """
    noise = sd * 2.0 * np.pi * np.sqrt(2.0 * Ts_s * speed_hz**3 / 3.0)
    memory = max(round(memory_s / Ts_s), 1)
    found = np.ones(speed.shape, bool)
    for i, (own, limit) in enumerate(zip(speed.T, _SURELY * noise, strict=True)):
        rests = binary_opening(np.abs(own) <= limit, np.ones(memory, bool))
        near = binary_dilation(rests, np.ones(memory // 2 * 2 + 1, bool))
        if not near.all():
            found[:, i] = ~near
    return found
