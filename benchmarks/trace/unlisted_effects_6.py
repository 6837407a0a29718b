"""Two more effects that no table of levid's has, by a sixth such author."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

Vector = Sequence[float]


class SteelPlate:
    """The beam's magnets are drawn to a plate of the base, less the higher: F = A (1 - e^(-h / l)).

    h = z + x_b theta is how much higher than at rest the platform is where the beam stands. The
    magnets of the beam's motor alternate with the period p, so that their field dies away as
    e^(-2 pi d / p) with the distance d (Furlani, Permanent Magnet and Electromechanical Devices,
    2001); steel is drawn by its square, B^2 / 2 mu_0 on each unit of area, hence with l = p / 4 pi.
    Such a pull is a spring of the stiffness -A / l that goes along with the beam: with the beam far
    out it softens theta, as x_b^2, and ties theta to z, as x_b, whatever the rods do.

    The pull A at h = 0 is a part of the beam's weight, which was weighed over the plate, and -A / l
    one of the stiffness in z, which was measured there: neither is in the wrench. With p = 60 mm,
    0.3 T at the magnets are 18 mT at a plate 27 mm away: 0.13 kPa, or 0.6 N on 50 cm^2. The plate
    is laminated, so that eddy currents are left out.
    """

    def __init__(self, pull_n: float, period_m: float) -> None:
        if not period_m > 0.0:
            raise ValueError(f"period_m: expected a number above 0, found {period_m!r}")
        self.pull_n, self._length_m = pull_n, period_m / (4.0 * math.pi)

    def reset(self, plant: Any) -> None:
        self._half_step_s = 0.5 * plant.dt_s

    def wrench(self, t_s: float, q: Vector, qd: Vector, beam: Any) -> Vector:
        # The force is held over the step: the pose in its middle, or a spring would be a damper.
        z = float(q[2]) + self._half_step_s * float(qd[2])
        theta = float(q[1]) + self._half_step_s * float(qd[1])
        force = -self.pull_n * math.expm1(-(z + beam.x_m * theta) / self._length_m)
        return (0.0, beam.x_m * force, force - self.pull_n * z / self._length_m)


class PumpedBus:
    """A sensor's supply rises as the beam brakes: h = h + e W / W_0, W what its bus has too much.

    W' = -m_b a_b (v_b + tau a_b) - P_0, and W >= 0. The motor gives back what the beam loses of its
    speed, all but what its own winding takes, tau = R m_b / K^2 with R the winding's resistance and
    K the constant of force. The rectifier lets nothing back into the mains, and the energy charges
    the capacitor of the drive's bus (Mohan, Undeland and Robbins, Power Electronics, 2003, on
    braking). There it stays until the next start takes it out again or the drive has used it up,
    P_0; then the rectifier conducts, and the bus is where it was. So the reading depends on what
    the beam did before: it creeps back while the beam stands, and is right again once that goes.

    The sensor's amplifier is fed from this bus through a regulator, and lets through what that does
    not hold back: 0.1 J on 2.2 mF at 48 V are 0.95 V, which after 34 dB are 19 mV, and at 5 V/mm
    4 um. W is small against what the capacitor holds at rest, 2.5 J, so that the voltage goes with
    it. Friction and slope are left out of the motor's work. No force acts on the platform.
    """

    def __init__(
        self,
        sensor: int,
        offset_m: float,
        rated_j: float,
        m_b_kg: float,
        motor_s: float,
        drain_w: float,
    ) -> None:
        if not rated_j > 0.0:
            raise ValueError(f"rated_j: expected a number above 0, found {rated_j!r}")
        self.sensor, self.m_b_kg = sensor, m_b_kg
        self.motor_s, self.drain_w = motor_s, drain_w
        self._m_j = offset_m / rated_j

    def reset(self, plant: Any) -> None:
        # `gap` is asked once before the first step, when the bus is at rest.
        self._dt_s, self._spare_j = plant.dt_s, 0.0

    def wrench(self, t_s: float, q: Vector, qd: Vector, beam: Any) -> Vector:
        drawn_w = self.m_b_kg * beam.a_m_s2 * (beam.v_m_s + self.motor_s * beam.a_m_s2)
        self._spare_j = max(self._spare_j - self._dt_s * (drawn_w + self.drain_w), 0.0)
        return (0.0, 0.0, 0.0)

    def gap(self, t_s: float, gap_m: Any) -> Any:
        gap_m[self.sensor] += self._m_j * self._spare_j
        return gap_m
