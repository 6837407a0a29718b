"""One more effect that no table of levid's has, at one sensor's wiring, by a fifth such author."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

Vector = Sequence[float]


class SharedReturn:
    """A sensor's ground is a phase's return as well: h = h + e (a_b / a_0) cos(2 pi x_b / p + f).

    Where two circuits have a length of conductor in common, the current of one is a voltage in the
    other (common-impedance coupling: Ott, Electromagnetic Compatibility Engineering, 2009). Here
    the amplifier of one phase of the beam's motor sends its current back along the lead that the
    sensor's output is measured against. A synchronous motor with sinusoidal commutation pushes with
    F = m_b a_b at every place, so that a phase carries F / K cos(2 pi x_b / p + f), K the constant
    of force, p the length of a pair of poles (Gieras, Piech and Tomczuk, Linear Synchronous Motors,
    2012). The sensor reads too much or too little as often as the beam passes a pole, by as much as
    the motor works just then; while the beam stands, or goes evenly, it reads right.

    e is the phase's full share at the acceleration a_0: 3.5 N at 6 N/A are 0.6 A, which along a
    metre of 0.5 mm^2 of copper, 35 mOhm, are 20 mV, and at 5 V/mm 4 um. What the motor needs
    against friction and slope is left out. No force acts on the platform.
    """

    def __init__(
        self, sensor: int, offset_m: float, rated_m_s2: float, period_m: float, phase_rad: float
    ) -> None:
        for key, value in (("rated_m_s2", rated_m_s2), ("period_m", period_m)):
            if not value > 0.0:
                raise ValueError(f"{key}: expected a number above 0, found {value!r}")
        self.sensor, self.phase_rad = sensor, phase_rad
        self._share_s2 = offset_m / rated_m_s2
        self._wave_1_m = 2.0 * math.pi / period_m

    def reset(self, plant: Any) -> None:
        # `gap` is asked once before the first step, when the beam is at rest.
        self._seen_m = 0.0

    def wrench(self, t_s: float, q: Vector, qd: Vector, beam: Any) -> Vector:
        angle = self._wave_1_m * beam.x_m + self.phase_rad
        self._seen_m = self._share_s2 * beam.a_m_s2 * math.cos(angle)
        return (0.0, 0.0, 0.0)

    def gap(self, t_s: float, gap_m: Any) -> Any:
        gap_m[self.sensor] += self._seen_m
        return gap_m
