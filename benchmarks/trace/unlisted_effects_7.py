"""Two more effects that no table of levid's has, by a seventh such author."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

Vector = Sequence[float]


class WavyRail:
    """The beam runs over a rail that is not straight: F = -m_b w'', w = A cos(2 pi x_b / p + f).

    w is how much higher than a straight line the beam's mass goes at x_b, and with k = 2 pi / p

        F = m_b A k (k v_b^2 cos(k x_b + f) + a_b sin(k x_b + f))

    is what the platform feels there, as a bridge does under a waggon on an uneven track (Fryba,
    Vibration of Solids and Structures under Moving Loads, 1999). Rails of ball guides are drawn
    down at each of their screws, so that p is the pitch of the holes, 20 mm on the smallest ones;
    a carriage follows it by some micrometres, less what its length averages out (Hu, Lei and Ou,
    Machines 9 (2021) 33, on how the errors of rail and motion go together). The weight is where it
    was: a beam at rest, or slow, shows nothing. The force grows with the speed squared, and its
    frequency with the speed.

    5 um at 20 mm and 0.4 m/s are 79 mm/s^2 up and down, 20 times a second: 0.11 N of 1.4 kg. That
    the carriage pitches on the wave, by 2 mrad, is left out, and so is the slope that the drive
    goes up and down by, 22 mN.
    """

    def __init__(self, height_m: float, period_m: float, phase_rad: float, m_b_kg: float) -> None:
        if not period_m > 0.0:
            raise ValueError(f"period_m: expected a number above 0, found {period_m!r}")
        self.height_m, self.phase_rad, self.m_b_kg = height_m, phase_rad, m_b_kg
        self._wave_1_m = 2.0 * math.pi / period_m

    def wrench(self, t_s: float, q: Vector, qd: Vector, beam: Any) -> Vector:
        k, v = self._wave_1_m, beam.v_m_s
        angle = k * beam.x_m + self.phase_rad
        bend = k * v * v * math.cos(angle) + beam.a_m_s2 * math.sin(angle)
        force = self.m_b_kg * self.height_m * k * bend
        return (0.0, beam.x_m * force, force)


class WarmPost:
    """A coil warms the post of the sensor below it: h = h - e (w - 1), T w' = (F / F_0)^2 - w.

    F is the coil's force, and its copper's loss goes with the square. What it warms grows, and the
    sensor stands on that: the gap it sees gets shorter (thermal errors of machines: Bryan, CIRP
    Annals 39 (1990) 645; Mayr et al., CIRP Annals 61 (2012) 771). Copper and post are one body of
    the time constant T, which forgets a load as slowly as it takes it up, so that the reading tells
    of what the coil carried for the last minute: of the beam's weight, if the coil is off the
    middle, and where the beam stood. w is 1 at the force F_0 that the coil carries at rest with the
    beam in the middle, where the sensors were zeroed on a warm rig. A flight begins cold.

    7.63 N at 8 N/A are 0.95 A, or 2.7 W in 3 Ohm. 10 g of copper on 8 g of aluminium, 11 J/K, with
    4 K/W to the base get 11 K warmer, with T = 44 s, and a post of 32 mm longer by 8 um. The coil's
    own force is not changed: its amplifier holds the current, and what its magnets lose is left
    out. No force acts on the platform.
    """

    def __init__(
        self, sensor: int, coil: int, growth_m: float, rest_n: float, time_constant_s: float
    ) -> None:
        for key, value in (("rest_n", rest_n), ("time_constant_s", time_constant_s)):
            if not value > 0.0:
                raise ValueError(f"{key}: expected a number above 0, found {value!r}")
        self.sensor, self.coil, self.growth_m = sensor, coil, growth_m
        self.rest_n, self.time_constant_s = rest_n, time_constant_s

    def reset(self, plant: Any) -> None:
        # `gap` is asked once before the first step, when all is cold.
        self._rate, self._warmth = -math.expm1(-plant.dt_s / self.time_constant_s), 0.0

    def coil_force(self, t_s: float, q: Vector, force_n: Any) -> Any:
        load = float(force_n[self.coil]) / self.rest_n
        self._warmth += self._rate * (load * load - self._warmth)
        return force_n

    def gap(self, t_s: float, gap_m: Any) -> Any:
        gap_m[self.sensor] -= self.growth_m * (self._warmth - 1.0)
        return gap_m
