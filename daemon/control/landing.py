"""Land from any point of a flight, computed cycle by cycle without a plan."""

from __future__ import annotations

from bisect import bisect_right
from math import ceil, isfinite

import numpy as np
from numba import njit
from numpy.typing import NDArray

from ...config.rig import Limits
from .control_cycle import Controller
from .flight_segment import Segment
from .states import State

Motion = tuple[NDArray[np.float64], NDArray[np.float64]]
"""Setpoints of beam and rotor, (1, 3) each: position, velocity, acceleration in SI units."""


class Landing:
    """Lower the platform onto the stops, fade out the force, and brake beam and rotor.

    Fly `segment`; call `set_row(k)` before cycle k to set its single-row arrays.
    """

    def __init__(self, controller: Controller, limits: Limits, period_s: float) -> None:
        self._controller, self._period_s = controller, period_s
        self._decelerations = limits.beam_acceleration_m_s2, limits.rotor_acceleration_rad_s2
        self._blend, self._motion = np.zeros((1, 3)), np.zeros((2, 1, 3))
        self._brakes = np.zeros((2, 4))
        self._ramp = self._release = 1
        self.segment = Segment(
            State.LANDING,
            0,
            np.zeros((1, 3)),
            np.zeros((1, len(controller.coil_n))),
            self._blend,
            self._motion[0],
            self._motion[1],
            airborne=False,
            lands=True,
        )
        self.begin(1, 1)  # compile now, before a landing is needed
        self.set_row(0)

    def begin(self, ramp: int, release: int) -> None:
        """Start landing: `ramp` cycles to lower the platform, `release` to fade out the force."""
        self._ramp, self._release = max(ramp, 1), max(release, 1)
        self.brake()

    def brake(self) -> Motion:
        """Start braking; return the setpoint arrays of beam and rotor, updated by `set_motion`."""
        control = self._controller
        for brake, at, deceleration in zip(
            self._brakes, (control.beam_ref, control.rotor_ref), self._decelerations, strict=True
        ):
            velocity = at[1] if isfinite(at[1]) else 0.0  # setpoint not finite: brake anyway
            n = max(ceil(abs(velocity) / (deceleration * self._period_s)), 1)
            brake[:] = at[0], velocity, -velocity / (n * self._period_s), n
        self.set_motion(0)
        return self._motion[0], self._motion[1]

    def set_motion(self, k: int) -> bool:
        """Set beam and rotor setpoints of cycle `k`; return False once both are at rest."""
        motion_row(k, self._period_s, self._brakes, self._motion)
        return bool(k + 1 < self._brakes[:, 3].max())

    def row_after(self, blend: NDArray[np.float64]) -> int:
        """Return the cycle that continues another landing from its `blend` (3,)."""
        sinking = blend[0] > 0.0
        first, count = (0, self._ramp) if sinking else (self._ramp, self._release)
        level = float(blend[0] if sinking else blend[2])
        return first + bisect_right(range(count), -level, key=lambda k: -smooth(1.0 - k / count))

    def set_row(self, k: int) -> bool:
        """Set the segment's rows for cycle `k`; return False if the landing is complete."""
        if k >= self._ramp + self._release:
            return False
        landing_row(
            k, self._ramp, self._release, self._period_s, self._blend[0], self._brakes,
            self._motion,
        )  # fmt: skip
        return True


@njit(cache=True)
def smooth(s):  # type: ignore[no-untyped-def]
    """Return the fifth-order smooth step at `s`, 0 to 1: zero velocity at both ends."""
    return s**3 * (10.0 + s * (-15.0 + 6.0 * s))


@njit(cache=True)
def landing_row(k, ramp, release, Ts, blend, brakes, motion) -> None:  # type: ignore[no-untyped-def]
    """Compute blend (3,) and motion (2, 1, 3) of cycle k; see motion_row for brakes."""
    sinking = k < ramp
    s = (ramp - k) / ramp if sinking else (ramp + release - k) / release
    level = smooth(s)
    blend[0] = level if sinking else 0.0
    blend[1] = 1.0
    blend[2] = 1.0 if sinking else level
    motion_row(k, Ts, brakes, motion)


@njit(cache=True)
def motion_row(k, Ts, brakes, motion) -> None:  # type: ignore[no-untyped-def]
    """Compute motion (2, 1, 3) of cycle k from brakes (2, 4): x, v, a at k = 0, and cycles."""
    for i in range(2):
        x, v, a, n = brakes[i, 0], brakes[i, 1], brakes[i, 2], brakes[i, 3]
        t = min(k + 1, n) * Ts
        motion[i, 0, 0] = x + v * t + a * t * t / 2
        braking = k + 1 < n
        motion[i, 0, 1] = v + a * t if braking else 0.0
        motion[i, 0, 2] = a if braking else 0.0
