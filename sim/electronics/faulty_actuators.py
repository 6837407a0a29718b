"""Injected faults of amplifiers and drives that no self-test detects: wrong force, no motion."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

SLOW_S = 0.3
"""Time constant of a slow drive."""
_LAG_S = {"slow": SLOW_S, "jam": math.inf}
_DRIVE = {"x1": 0, "x2": 0, "phi": 1}
"""Row of a motor's motion. One motor that jams holds the whole beam."""


class FaultyActuators:
    """Turn commands into what faulty amplifiers and drives do. Without a fault they do the same.

    force: gain and offset in N of a faulty coil's amplifier, by its number. lag_s: time constant of
    a faulty drive, infinite for one that does not move: 0 is the beam, 1 the rotor.
    """

    def __init__(self) -> None:
        self.force: dict[int, tuple[float, float]] = {}
        self.lag_s: dict[int, float] = {}
        self._at = np.zeros(2)

    def set_force(self, fault: str, coil: int, number: float) -> None:
        """Begin the fault coil-force, coil-gain or coil-offset of a coil."""
        self.force[coil] = {
            "coil-force": (0.0, number),
            "coil-gain": (number, 0.0),
            "coil-offset": (1.0, number),
        }[fault]

    def delay_drive(self, fault: str, motor: str) -> None:
        """Begin the fault slow or jam of the motor x1, x2 or phi."""
        self.lag_s[_DRIVE[motor]] = _LAG_S[fault]

    def forces(self, coil_n: Array) -> Array:
        """Return the forces (C,) in N that the amplifiers drive."""
        if not self.force:
            return coil_n
        driven = coil_n.copy()
        for coil, (gain, offset_n) in self.force.items():
            driven[coil] = gain * coil_n[coil] + offset_n
        return driven

    def motion(self, setpoint: Array, period_s: float) -> Array:
        """Return the motion (2, 3) of beam and rotor at the end of a period: x, v, a."""
        if not self.lag_s:
            self._at[:] = setpoint[:, 0]
            return setpoint
        moved = setpoint.copy()
        for drive, lag_s in self.lag_s.items():
            step = -math.expm1(-period_s / lag_s) * (setpoint[drive, 0] - self._at[drive])
            moved[drive] = self._at[drive] + step, step / period_s, 0.0
        self._at[:] = moved[:, 0]
        return moved

    def where(self, setpoint: Array) -> Array:
        """Return the positions (2,) at which drives stop that get no further setpoints."""
        return self._at.copy() if self.lag_s else setpoint[:, 0]

    def clear(self) -> None:
        """Repair everything."""
        self.force.clear()
        self.lag_s.clear()
