"""Host's look at readings of sensors and drives: what no sane device would say is an error."""

from __future__ import annotations

import numpy as np
from numba import njit

from ..config.rig import Geometry
from ..model.geometry import decoupling_matrix, shape_matrix
from ..wire.device_protocol import SensorState
from .base import Array, DriveError, SensorError

_FROZEN_CYCLES = 20
"""How often a reading repeats itself before it is suspected. With noise of 0.1 um rms and counts of
31 nm a channel repeats one with probability 0.09; twenty in a row are once in 1e20."""
_OFF_M = 3e-7
"""How far a suspected channel must leave the plane that all sensors together see: without noise a
sound one repeats itself too, but then it stays in it."""


_HELD_CYCLES = 3
_FAR_OFF_M = 1e-6
"""So far off the plane a channel is frozen after three repeats: a sound one that moves so far does
not repeat itself at all, let alone, with that noise, once in 1e3 at rest and so far off."""


class SensorWatch:
    """Looks for channels without a reading, at the end of their range, or frozen."""

    def __init__(self, what: str, geometry: Geometry, range_m: float) -> None:
        self._what, self._end_m = what, 0.9999 * range_m
        x, y = geometry.sensors_x_m, geometry.sensors_y_m
        # What remains of readings once the pose that fits them best is taken out.
        self._off_plane = np.eye(len(x)) - shape_matrix(x, y) @ decoupling_matrix(x, y)
        self._last = np.full(len(x), np.nan)
        self._repeats = np.zeros(len(x), np.int64)
        self._off_before = np.zeros(len(x))
        self._missed = np.zeros(len(x), np.bool_)
        self._told = False
        # Compiled here, not in a cycle: no reading yet is one that repeats nothing.
        _judge(
            np.zeros(len(x)), self._last.copy(), self._repeats.copy(), self._off_before.copy(),
            self._missed.copy(), self._off_plane, range_m,
        )  # fmt: skip

    def judge(self, gap_m: Array, state: int = SensorState.OK) -> None:
        """Look at a fresh reading (S,) in m; nan becomes the last one, so that the loop can go on.

        `state` is what the ADC says of itself: what it calls faulty is not believed, number or not.

        Raises:
            SensorError: a channel is not to be trusted; raised once, until `reset`.
        """
        bad = _judge(
            gap_m, self._last, self._repeats, self._off_before, self._missed, self._off_plane,
            self._end_m,
        )  # fmt: skip
        if bad and not self._told:
            self._told = True
            what = {1: "no reading", 2: "at the end of its range", 3: "frozen"}[bad % 4]
            raise SensorError(f"{self._what}: sensor {bad // 4}: {what}")
        if state != SensorState.OK and not self._told:
            self._told = True
            raise SensorError(
                f"{self._what}: the ADC says that a channel is faulty (state {state})"
            )

    def reset(self) -> None:
        """Begin anew after a fault."""
        self._told = False
        self._missed[:] = True  # a channel that was mended has moved the plane: see `_judge`


@njit(cache=True)
def _judge(  # type: ignore[no-untyped-def]
    gap, last, repeats, off_before, missed, off_plane, end
) -> int:
    """Return 4 times the channel plus what is wrong with it, 0 if nothing is."""
    bad = 0
    back = False
    for i in range(gap.size):
        absent = np.isnan(gap[i])
        if absent:
            bad = 4 * i + 1
            gap[i] = last[i]
        back = back or (missed[i] and not absent)
        missed[i] = absent
    if back:  # where it is by now moves the plane, and nobody else
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
    """Raise DriveError where the gantry's motors are further apart than `limit_m`."""
    if abs(x1_m - x2_m) > limit_m:
        raise DriveError(
            f"{what}: X1 and X2 are {1e3 * abs(x1_m - x2_m):.3f} mm apart, "
            f"at most {1e3 * limit_m:.3f} mm are allowed"
        )
