"""Find where a DOF rests: its speed is not told from zero for longer than it takes to turn."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation

from ...rounding import ROUNDED_SD
from ..search_options import SearchOptions

Array = NDArray[np.float64]

_TURNS = 2.0
"""Duration over that of a turn from which on it is a rest: as if it turned at half the rate."""


def moving_rows(
    speed: Array, sd: Array, Ts_s: float, speed_hz: float, memory_s: float
) -> NDArray[np.bool_]:
    """Return where each DOF moves (N, n).

    speed (N, n): per s, below `speed_hz`, of outputs with white noise of deviation sd (n,).
    memory_s: memory of the low-pass of the force balance; rows within half of it of a rest count as
    rest. Dry friction holds a DOF with any force while it rests, also for a moment at a reversal. A
    DOF that moves in no row is taken to move in all.
    """
    # The frequencies of a flat spectrum are spread evenly from -speed_hz to speed_hz.
    rms_hz = 2.0 * speed_hz * ROUNDED_SD
    noise = sd * 2.0 * np.pi * rms_hz * np.sqrt(2.0 * Ts_s * speed_hz)
    memory = max(round(memory_s / Ts_s), 1)
    found = np.ones(speed.shape, bool)
    surely = SearchOptions.chance(len(speed))
    for i, (own, limit) in enumerate(zip(speed.T, surely * noise, strict=True)):
        rests = _rests(np.abs(own), float(limit), memory)
        near = binary_dilation(rests, np.ones(memory // 2 * 2 + 1, bool))
        if not near.all():
            found[:, i] = ~near
    return found


def away_from_turns(speed: Array, Ts_s: float, memory_s: float) -> NDArray[np.bool_]:
    """Return the rows (N, n) farther than half of a memory from where a speed (N, n) turns.

    With dry friction the acceleration jumps there. A speed below a limit is round, and turns a part
    of a row early or late.
    """
    memory = max(round(memory_s / Ts_s), 1)
    turns = np.zeros(speed.shape, bool)
    turns[1:] = speed[1:] * speed[:-1] <= 0.0
    return ~binary_dilation(turns, np.ones((memory // 2 * 2 + 1, 1), bool))


def _rests(speed: Array, limit: float, memory: int) -> NDArray[np.bool_]:
    """Return the rows (N,) of rests, of the size of a speed below a limit.

    A turn crosses from -limit to limit at the rate by which the speed grows before and after it.
    What lasts longer than the memory is a rest at any rate.
    """
    slow = np.concatenate([[False], speed <= limit, [False]])
    edges = np.flatnonzero(slow[1:] != slow[:-1]).reshape(-1, 2)
    aside = max(memory // SearchOptions.resolved, 1)
    before = speed[np.maximum(edges[:, 0] - aside, 0)] - limit
    after = speed[np.minimum(edges[:, 1] - 1 + aside, len(speed) - 1)] - limit
    rate = np.maximum(before + after, 0.0) / (2.0 * aside)
    rows = edges[:, 1] - edges[:, 0]
    # Two rows at least: one may be slow by chance.
    rest = (rows > 1) & (rows * rate > _TURNS * 2.0 * limit) | (rows >= memory)
    found = np.zeros(len(speed), bool)
    for begin, end in edges[rest].tolist():
        found[begin:end] = True
    return found
