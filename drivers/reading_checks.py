"""Check sensor readings and drive positions: missing, at the range limit, frozen, skewed."""

from __future__ import annotations

import numpy as np
from numba import njit

from ..config.rig import Geometry
from ..model.geometry import decoupling_matrix, shape_matrix
from ..wire.device_protocol import SensorState
from .base import Array, DriveError, SensorError

_FROZEN_CYCLES = 20
"""Equal readings in a row after which a channel is suspect. With noise of 0.1 um rms and counts of
31 nm a reading repeats with probability 0.09: twenty in a row have a probability of 1e-20."""
_OFF_M = 3e-7
"""Least change of a suspect channel's distance from the plane through all readings, in m. Without
noise a working channel repeats its reading too, but stays in the plane."""
_HELD_CYCLES = 3
_FAR_OFF_M = 1e-6
"""Change of the distance from the plane, in m, above which three repeats suffice. A working channel
that moves so far does not repeat; at rest, with that noise, it does so once in 1e3."""


class SensorWatch:
    """Detects channels without a reading, at the end of their range, or frozen."""

    def __init__(self, what: str, geometry: Geometry, range_m: float) -> None:
        self._what, self._end_m = what, 0.9999 * range_m
        x, y = geometry.sensors_x_m, geometry.sensors_y_m
        # Residual of the readings after a least-squares fit of the pose.
        self._off_plane = np.eye(len(x)) - shape_matrix(x, y) @ decoupling_matrix(x, y)
        self._last = np.full(len(x), np.nan)
        self._repeats = np.zeros(len(x), np.int64)
        self._off_before = np.zeros(len(x))
        self._missed = np.zeros(len(x), np.bool_)
        self._reported = False
        # Compile before the first cycle; copies, because the call writes to its arguments.
        _check(
            np.zeros(len(x)), self._last.copy(), self._repeats.copy(), self._off_before.copy(),
            self._missed.copy(), self._off_plane, range_m,
        )  # fmt: skip

    def judge(self, gap_m: Array, state: int = SensorState.OK) -> None:
        """Check a new reading (S,) in m; nan becomes the last reading, so that the loop continues.

        `state` is the ADC's own state; FAULTY is an error even if all readings are numbers.

        Raises:
            SensorError: a channel is faulty; raised once until `reset`.
        """
        bad = _check(
            gap_m, self._last, self._repeats, self._off_before, self._missed, self._off_plane,
            self._end_m,
        )  # fmt: skip
        if bad and not self._reported:
            self._reported = True
            what = {1: "no reading", 2: "at the end of its range", 3: "frozen"}[bad % 4]
            raise SensorError(f"{self._what}: sensor {bad // 4}: {what}")
        if state != SensorState.OK and not self._reported:
            self._reported = True
            raise SensorError(f"{self._what}: the ADC reports a faulty channel (state {state})")

    def reset(self) -> None:
        """Start again after a fault."""
        self._reported = False
        self._missed[:] = True  # a repaired channel shifts the plane: see `_check`


@njit(cache=True)
def _check(  # type: ignore[no-untyped-def]
    gap, last, repeats, off_before, missed, off_plane, end
) -> int:
    """Return 4 times the channel plus the kind of defect, 0 if there is none."""
    bad = 0
    back = False
    for i in range(gap.size):
        absent = np.isnan(gap[i])
        if absent:
            bad = 4 * i + 1
            gap[i] = last[i]
        back = back or (missed[i] and not absent)
        missed[i] = absent
    if back:  # the plane shifts although no other channel moved
        repeats[:] = 0
        for i in range(gap.size):
            off_before[i] = 0.0
            for j in range(gap.size):
                off_before[i] += off_plane[i, j] * gap[j]
    for i in range(gap.size):
        off = 0.0
        for j in range(gap.size):
            off += off_plane[i, j] * gap[j]
        if abs(gap[i]) >= end and not bad:
            bad = 4 * i + 2
        if gap[i] != last[i]:
            repeats[i] = 0
            off_before[i] = off
        else:
            repeats[i] += 1
            moved = abs(off - off_before[i])
            frozen = (repeats[i] >= _FROZEN_CYCLES and moved > _OFF_M) or (
                repeats[i] >= _HELD_CYCLES and moved > _FAR_OFF_M
            )
            if frozen and not bad:
                bad = 4 * i + 3
        last[i] = gap[i]
    return bad


def check_skew(what: str, x1_m: float, x2_m: float, limit_m: float) -> None:
    """Raise DriveError if the positions of the gantry's motors differ by more than `limit_m`."""
    if abs(x1_m - x2_m) > limit_m:
        raise DriveError(
            f"{what}: expected X1 and X2 within {1e3 * limit_m:.3f} mm of each other, "
            f"found {1e3 * abs(x1_m - x2_m):.3f} mm"
        )
