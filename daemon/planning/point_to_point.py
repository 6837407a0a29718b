"""Compute point-to-point moves of beam and rotor within velocity and acceleration limits."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

# Peak velocity and acceleration of the minimum-jerk polynomial over distance/T and distance/T^2.
_PEAK_VELOCITY = 15.0 / 8.0
_PEAK_ACCELERATION = 10.0 / math.sqrt(3.0)
_LONGEST_S = 3600.0


def move(start: float, end: float, velocity: float, acceleration: float, Ts_s: float) -> Array:
    """Return setpoints (n, 3) of position, velocity, acceleration from rest to rest.

    The profile is the minimum-jerk quintic (Flash and Hogan, 1985), as short as the limits allow;
    the last row is `end` at rest. Units follow the arguments.

    Raises ValueError if the move takes more than an hour.
    """
    distance = end - start
    if distance == 0.0:
        return np.array([[end, 0.0, 0.0]])
    duration = max(
        _PEAK_VELOCITY * abs(distance) / velocity,
        math.sqrt(_PEAK_ACCELERATION * abs(distance) / acceleration),
    )
    if duration > _LONGEST_S:
        raise ValueError(
            f"expected a move of at most {_LONGEST_S:g} s, found {duration:.3g} s; move faster"
        )
    n = max(math.ceil(duration / Ts_s), 1)
    duration = n * Ts_s
    s = np.arange(1, n + 1) / n
    position = start + distance * s**3 * (10.0 + s * (-15.0 + 6.0 * s))
    speed = distance / duration * 30.0 * s**2 * (1.0 - s) ** 2
    accel = distance / duration**2 * 60.0 * s * (1.0 - s) * (1.0 - 2.0 * s)
    setpoints = np.stack([position, speed, accel], axis=1)
    setpoints[-1] = end, 0.0, 0.0
    return setpoints


@dataclass(frozen=True)
class Leg:
    """Define a move to `to` within limits, then `dwell_s` at rest; units as in `move`."""

    to: float
    velocity: float
    acceleration: float
    dwell_s: float


class Repeated:
    """Legs that start at `start` and repeat for `n` cycles.

    A move that would not end within n cycles is not started: the axis holds its position.
    """

    def __init__(self, start: float, legs: Sequence[Leg], n: int, Ts_s: float) -> None:
        """Raise ValueError if the first move takes more than n cycles."""
        self._start, self._legs, self._n, self._Ts_s = start, legs, n, Ts_s
        self._moves: dict[tuple[float, int], Array] = {}
        self.end = start
        """Position at the end."""
        for _, part, _ in self._walk():
            self.end = float(part[-1, 0])

    def moves(self) -> Array:
        """Return the setpoints (m, 3) of the different moves, and the position before them."""
        return np.vstack([hold(self._start, 1), *self._moves.values()])

    def setpoints(self) -> Array:
        """Return the setpoints (n, 3) of position, velocity and acceleration."""
        setpoints = hold(self.end, self._n)
        for at, part, dwell in self._walk():
            end = at + len(part)
            setpoints[at:end] = part
            setpoints[end : end + dwell, 0] = part[-1, 0]
        return setpoints

    def _walk(self) -> Iterator[tuple[int, Array, int]]:
        """Yield first cycle, setpoints and cycles of rest after it of each move."""
        n, length, at = self._n, 0, self._start
        while length < n:
            before = length
            for number, leg in enumerate(self._legs):
                part = self._moves.get((at, number))
                if part is None:
                    part = move(at, leg.to, leg.velocity, leg.acceleration, self._Ts_s)
                    self._moves[at, number] = part
                if length + len(part) > n:
                    if not length:
                        raise ValueError(
                            f"expected a move within the record's {n * self._Ts_s:g} s, found one "
                            f"of {len(part) * self._Ts_s:g} s; move faster or record longer"
                        )
                    return
                dwell = min(round(leg.dwell_s / self._Ts_s), n - length - len(part))
                yield length, part, dwell
                length, at = length + len(part) + dwell, leg.to
                if length == n:
                    return
            if length - before <= len(self._legs):
                return  # moves and dwells of zero length: hold for the rest


def brake(position: float, velocity: float, acceleration: float, Ts_s: float) -> Array:
    """Return setpoints (n, 3) that brake a motion to rest at constant deceleration."""
    n = max(math.ceil(abs(velocity) / (acceleration * Ts_s)), 1)
    t, duration = np.arange(1, n + 1) * Ts_s, n * Ts_s
    a = -velocity / duration
    setpoints = np.empty((n, 3))
    setpoints[:, 0] = position + velocity * t + a * t**2 / 2
    setpoints[:, 1] = velocity + a * t
    setpoints[:, 2] = a
    setpoints[-1, 1:] = 0.0
    return setpoints


def hold(position: float, n: int) -> Array:
    """Return setpoints (n, 3) at rest at `position`."""
    setpoints = np.zeros((n, 3))
    setpoints[:, 0] = position
    return setpoints
