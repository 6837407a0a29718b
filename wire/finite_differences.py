"""Velocity and acceleration of a sampled position from its last four samples."""

from __future__ import annotations

import math

_TIMES_ACCELERATION = 5.0
"""Targets that are carried forward overshoot where the acceleration changes its sign: by as much as
it can do in a period, four times in a second difference."""
ROUNDED_COUNTS = 4
"""By how much the second difference of rounded positions is off: four halves, on either side."""


def most_bend(acceleration: float, period_s: float, count: float) -> float:
    """Return the largest second difference of positions within a limit of acceleration.

    In the unit of a `count`, m or rad; `acceleration` in that per s^2.
    """
    return _TIMES_ACCELERATION * acceleration * period_s**2 + ROUNDED_COUNTS * count


class Differences:
    """Backward differences of third (velocity) and second order (acceleration).

    A drive in cyclic synchronous position mode gets positions alone, and a position encoder tells
    nothing else: with one difference of two samples, velocity would be that of half a period ago.

    `bend` is the largest second difference of a motion that is sampled evenly. Beyond it third
    order makes four times the speed of a position that stood still for one period and made up for
    it in the next, as where a target came late: there velocity is that of the last period.
    """

    def __init__(self, period_s: float, bend: float = math.inf) -> None:
        self._period_s, self._bend = period_s, bend
        self._last = (0.0, 0.0, 0.0)
        self._velocity = 0.0

    def at_rest(self, position: float) -> None:
        """Begin anew: nothing has moved."""
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
        """Return velocity and acceleration at a sample that did not come a period after the last.

        What passed in between is not known: it goes on at the speed it had.
        """
        step = self._velocity * self._period_s
        self._last = p, p - step, p - 2.0 * step
        return self._velocity, 0.0
