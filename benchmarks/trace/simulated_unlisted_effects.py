"""Simulated effects that no table of levid lists: they test what a trace reports of the unknown.

Each has the hooks of levid.sim.effects, which are called in the order coil_force, wrench, gap. A
docstring states the equation, its source in the literature, and where it helps a typical size.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

Vector = Sequence[float]

_AIR_KG_M3 = 1.2
_NO_WRENCH = (0.0, 0.0, 0.0)


class _OneSensor:
    """Add an error to one sensor's reading; no force acts on the platform."""

    def __init__(self, sensor: int) -> None:
        self._sensor, self._error_m = sensor, 0.0

    def gap(self, t_s: float, gap_m: Any) -> Any:
        gap_m[self._sensor] += self._error_m
        return gap_m


class HungPlug:
    """A plug on a springy cable at (x, y): m u'' = -k (u - h) - c (u' - h'), h the point's height.

    The platform gets k (u - h) + c (u' - h') there, k = m (2 pi f)^2, c = 2 zeta m 2 pi f: a tuned
    absorber (Den Hartog 1934). The plug's static weight is part of the model.
    """

    def __init__(
        self, mass_kg: float, freq_hz: float, damping: float, x_m: float, y_m: float
    ) -> None:
        w = 2.0 * math.pi * freq_hz
        self.mass_kg, self.x_m, self.y_m = mass_kg, x_m, y_m
        self.k_n_m, self.c_n_s_m = mass_kg * w * w, 2.0 * damping * mass_kg * w

    def reset(self, plant: Any) -> None:
        self.dt_s = plant.dt_s
        self.u_m: float | None = None
        self.rate_m_s = 0.0

    def wrench(self, t_s: float, q: Vector, qd: Vector, beam: Any) -> Vector:
        rate = float(qd[2]) + self.y_m * float(qd[0]) + self.x_m * float(qd[1])
        h = float(q[2]) + self.y_m * float(q[0]) + self.x_m * float(q[1]) + 0.5 * self.dt_s * rate
        if self.u_m is None:
            self.u_m = h
        self.u_m += self.dt_s * self.rate_m_s
        force = self.k_n_m * (self.u_m - h) + self.c_n_s_m * (self.rate_m_s - rate)
        self.rate_m_s -= self.dt_s * force / self.mass_kg
        return (self.y_m * force, self.x_m * force, force)


class EddyBrake:
    """A magnet of the base brakes the beam's vertical motion: F = -d e^(-s^2) (z' + x_b theta').

    s = (x_b - x_0) / w. The force depends on more than one DOF and on the beam's position.
    """

    def __init__(self, damping_n_s_m: float, at_m: float, width_m: float) -> None:
        self.damping_n_s_m, self.at_m, self.width_m = damping_n_s_m, at_m, width_m

    def wrench(self, t_s: float, q: Vector, qd: Vector, beam: Any) -> Vector:
        near = math.exp(-(((beam.x_m - self.at_m) / self.width_m) ** 2))
        force = -self.damping_n_s_m * near * (float(qd[2]) + beam.x_m * float(qd[1]))
        return (0.0, beam.x_m * force, force)


class ClosedCover:
    """The beam is a piston under a closed cover: tau_theta = -B dp (L^2 - x_b^2) / 2.

    dp = rho / 2 zeta v_b |v_b| drives the air past the beam (zeta: Idelchik, Handbook of Hydraulic
    Resistance); the cover is B wide and 2 L long. A narrow slit leaks as much ahead of the beam as
    behind it: dp (L + x_b) / 2 L presses on the length L - x_b ahead, and dp (L - x_b) / 2 L lifts
    the length L + x_b behind, which is a torque without a force.
    """

    def __init__(self, zeta: float, width_m: float, half_length_m: float) -> None:
        self.half_length_m = half_length_m
        self._n_s2_m3 = 0.5 * width_m * 0.5 * _AIR_KG_M3 * zeta

    def wrench(self, t_s: float, q: Vector, qd: Vector, beam: Any) -> Vector:
        spread_m2 = self.half_length_m**2 - beam.x_m * beam.x_m
        return (0.0, -self._n_s2_m3 * beam.v_m_s * abs(beam.v_m_s) * spread_m2, 0.0)


class SecondStage:
    """An amplifier switches to its stage for large currents: F = F + u e, u = 1 or 0.

    A relay with hysteresis: u becomes 1 at F >= `on_n` and 0 at F <= `off_n`. e is the difference
    of the two stages' offsets, as between the rails of a class G amplifier.
    """

    def __init__(self, coil: int, step_n: float, on_n: float, off_n: float) -> None:
        self.coil, self.step_n = coil, step_n
        self.on_n, self.off_n = on_n, off_n

    def reset(self, plant: Any) -> None:
        self._on = False

    def coil_force(self, t_s: float, q: Vector, force_n: Any) -> Any:
        force = float(force_n[self.coil])
        self._on = force > self.off_n if self._on else force >= self.on_n
        if self._on:
            force_n[self.coil] += self.step_n
        return force_n


class WavyRail:
    """The beam runs over a wavy rail: F = m_b A k (k v_b^2 cos(k x_b + f) + a_b sin(k x_b + f)).

    The rail's height is A cos(k x_b + f), k = 2 pi / p (Fryba, Vibration of Solids and Structures
    under Moving Loads, 1999); p is the pitch of the rail's screws (Hu, Lei and Ou, Machines 9
    (2021) 33). 5 um at 20 mm and 0.4 m/s are 0.11 N of 1.4 kg. A beam at rest shows nothing.
    """

    def __init__(self, height_m: float, period_m: float, phase_rad: float, m_b_kg: float) -> None:
        self.height_m, self.phase_rad, self.m_b_kg = height_m, phase_rad, m_b_kg
        self._wave_1_m = 2.0 * math.pi / period_m

    def wrench(self, t_s: float, q: Vector, qd: Vector, beam: Any) -> Vector:
        k, v = self._wave_1_m, beam.v_m_s
        angle = k * beam.x_m + self.phase_rad
        bend = k * v * v * math.cos(angle) + beam.a_m_s2 * math.sin(angle)
        force = self.m_b_kg * self.height_m * k * bend
        return (0.0, beam.x_m * force, force)


class WarmPost(_OneSensor):
    """A coil warms the post of the sensor below it: h = h - e (w - 1), T w' = (F / F_0)^2 - w.

    Copper loss goes with the square of the force, and the post expands (Mayr et al., CIRP Annals 61
    (2012) 771). w is 1 at the force F_0 at rest, where sensors are zeroed; a flight begins cold.
    2.7 W with 4 K/W warm a post of 32 mm by 11 K: 8 um, T = 44 s.
    """

    def __init__(
        self, sensor: int, coil: int, growth_m: float, rest_n: float, time_constant_s: float
    ) -> None:
        super().__init__(sensor)
        self.coil, self.growth_m = coil, growth_m
        self.rest_n, self.time_constant_s = rest_n, time_constant_s

    def reset(self, plant: Any) -> None:
        self._rate = -math.expm1(-plant.dt_s / self.time_constant_s)
        self._warmth, self._error_m = 0.0, self.growth_m

    def coil_force(self, t_s: float, q: Vector, force_n: Any) -> Any:
        load = float(force_n[self.coil]) / self.rest_n
        self._warmth += self._rate * (load * load - self._warmth)
        self._error_m = -self.growth_m * (self._warmth - 1.0)
        return force_n


class RectifiedDrive(_OneSensor):
    """A sensor rectifies the rotor drive's switching: h = h - e 4 / (sqrt(3) pi) min(M, 1).

    M = |phi' + tau phi''| / W is the drive's modulation, W the rotor's top speed, tau = R J / K^2.
    The common-mode power of three half bridges (Holmes and Lipo, Pulse Width Modulation for Power
    Converters, 2003) is an offset behind an amplifier's input stage (Kitchin, Counts and
    Gerstenhaber, Analog Devices AN-671, 2003). Its mean over a turn is U^2 (9 / 4 - M 3 sqrt(3) /
    pi). e is the offset at rest, where the sensor is zeroed: 18 of 25 rad/s remove 5.3 of 10 um.
    """

    _TAKEN = 4.0 / (math.sqrt(3.0) * math.pi)

    def __init__(
        self, sensor: int, offset_m: float, end_speed_rad_s: float, motor_s: float
    ) -> None:
        super().__init__(sensor)
        self.offset_m, self.end_speed_rad_s, self.motor_s = offset_m, end_speed_rad_s, motor_s

    def wrench(self, t_s: float, q: Vector, qd: Vector, beam: Any) -> Vector:
        needs_rad_s = abs(beam.phi_rad_s + self.motor_s * beam.phi_rad_s2)
        self._error_m = -self.offset_m * self._TAKEN * min(needs_rad_s / self.end_speed_rad_s, 1.0)
        return _NO_WRENCH


class PassedCoil:
    """A coil also pushes the beam's magnets: F = F (1 + e s), u = (x_b - x_0) / c.

    s = (1 - 3 u^2 / 2) / (1 + u^2)^(7/2): two upright dipoles, one c over the other and u c beside
    it (Yung, Landecker and Villani, Magnetic and Electrical Separation 9 (1998) 39). 0.11 A m^2 of
    the coil at rest and 1.9 A m^2 of 2 cm^3 of NdFeB, 34 mm apart, are 0.1 N: 1.3 % of 7.63 N.
    """

    def __init__(self, coil: int, share: float, at_m: float, apart_m: float) -> None:
        self.coil, self.share, self.at_m, self.apart_m = coil, share, at_m, apart_m

    def reset(self, plant: Any) -> None:
        self._factor = 1.0  # coil_force is called before wrench, and uses the last step's beam

    def coil_force(self, t_s: float, q: Vector, force_n: Any) -> Any:
        force_n[self.coil] *= self._factor
        return force_n

    def wrench(self, t_s: float, q: Vector, qd: Vector, beam: Any) -> Vector:
        square = ((beam.x_m - self.at_m) / self.apart_m) ** 2
        self._factor = 1.0 + self.share * (1.0 - 1.5 * square) / (1.0 + square) ** 3.5
        return _NO_WRENCH
