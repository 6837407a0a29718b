"""Compute velocity and acceleration from the last four samples of a position."""

from __future__ import annotations

import math

_TIMES_ACCELERATION = 5.0
"""Extrapolated targets overshoot when the acceleration changes its sign: their second difference
adds up to four times that of the acceleration."""
ROUNDED_COUNTS = 4
"""Bound in counts on the rounding error of second differences: 4 x 0.5 at target and at encoder."""


def most_bend(acceleration: float, period_s: float, count: float) -> float:
    """Return the largest second difference of positions at a limit of acceleration.

    In the unit of `count`, m or rad; `acceleration` is in that unit per s^2.
    """
    return _TIMES_ACCELERATION * acceleration * period_s**2 + ROUNDED_COUNTS * count


class Differences:
    """Backward differences of third (velocity) and second order (acceleration).

    Drives in cyclic synchronous position mode exchange positions only. A difference of two samples
    would give the velocity half a period ago.

    `bend` is the largest second difference of an evenly sampled motion. Above it (a target was late
    and the drive caught up in the next period) the velocity is that of the last period: third order
    would return four times the velocity.
    """

    def __init__(self, period_s: float, bend: float = math.inf) -> None:
        self._period_s, self._bend = period_s, bend
        self._last = (0.0, 0.0, 0.0)
        self._velocity = 0.0

    def at_rest(self, position: float) -> None:
        """Start at rest at `position`."""
        self._last, self._velocity = (position, position, position), 0.0

    def push(self, p: float) -> tuple[float, float]:
        """Return velocity and acceleration at the newest sample `p`, per s and s^2."""
        a, b, c = self._last
        self._last = p, a, b
        T = self._period_s
        if max(abs(p - 2.0 * a + b), abs(a - 2.0 * b + c)) > self._bend:
            self._velocity = (p - a) / T
            return self._velocity, 0.0
        self._velocity = (11.0 * p - 18.0 * a + 9.0 * b - 2.0 * c) / (6.0 * T)
        return self._velocity, (2.0 * p - 5.0 * a + 4.0 * b - c) / (T * T)

    def resume(self, p: float) -> tuple[float, float]:
        """Return velocity and acceleration at a sample after a missing one.

        The number of missing periods is not used: the velocity stays as it was.
        """
        step = self._velocity * self._period_s
        self._last = p, p - step, p - 2.0 * step
        return self._velocity, 0.0
