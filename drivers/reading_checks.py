"""Check sensor readings and drive positions: missing, at the range limit, skewed.

Readings that stand still, or are off the plane of the others, are checked in the control cycle on
every backend: see daemon.control.sensor_checks.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from ..config.rig import Geometry
from ..wire.device_protocol import SensorState
from .base import Array, DriveError, SensorError


class SensorWatch:
    """Detects channels without a reading, or at the end of their range."""

    def __init__(self, what: str, geometry: Geometry, range_m: float) -> None:
        self._what, self._end_m = what, 0.9999 * range_m
        self._last = np.full(len(geometry.sensors_x_m), np.nan)
        self._reported = False
        _check(self._last.copy(), self._last.copy(), range_m)  # compile before the first cycle

    def judge(self, gap_m: Array, state: int = SensorState.OK) -> None:
        """Check a new reading (S,) in m; nan becomes the last reading, so that the loop continues.

        `state` is the ADC's own state; FAULTY is an error even if all readings are numbers.

        Raises:
            SensorError: a channel is faulty; raised once until `reset`.
        """
        bad = _check(gap_m, self._last, self._end_m)
        if bad and not self._reported:
            self._reported = True
            what = {1: "no reading", 2: "at the end of its range"}[bad % 4]
            raise SensorError(f"{self._what}: sensor {bad // 4}: {what}")
        if state != SensorState.OK and not self._reported:
            self._reported = True
            raise SensorError(f"{self._what}: the ADC reports a faulty channel (state {state})")

    def reset(self) -> None:
        """Start again after a fault."""
        self._reported = False


@njit(cache=True)
def _check(gap, last, end) -> int:  # type: ignore[no-untyped-def]
    """Return 4 times the channel plus the kind of defect, 0 if there is none."""
    bad = 0
    for i in range(gap.size):
        if np.isnan(gap[i]):
            bad = 4 * i + 1
            gap[i] = last[i]
        elif abs(gap[i]) >= end and not bad:
            bad = 4 * i + 2
        last[i] = gap[i]
    return bad


def check_skew(what: str, x1_m: float, x2_m: float, limit_m: float) -> None:
    """Raise DriveError if the positions of the gantry's motors differ by more than `limit_m`."""
    if abs(x1_m - x2_m) > limit_m:
        raise DriveError(
            f"{what}: expected X1 and X2 within {1e3 * limit_m:.3f} mm of each other, "
            f"found {1e3 * abs(x1_m - x2_m):.3f} mm"
        )
