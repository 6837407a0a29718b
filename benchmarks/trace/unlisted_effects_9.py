"""Two more effects that no table of levid's has, by a ninth such author."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

Vector = Sequence[float]


class RockingTable:
    """The table on its soft feet rocks, as the beam pushes off: F = -(m d + m_b (x_b + d)) b''.

    b is the table's angle, in the sense of theta. The beam pushes the table back, h over the feet,
    when it starts, and weighs it down on the side where it stands:

        b'' + 2 zeta w b' + w^2 b = m_b (h a_b - g x_b) / I
        torque = -(J + m_b x_b (x_b + d)) b''

    d is how far the platform's middle is from the line that the table rocks about, m and J are the
    platform's without the beam. Coils and sensors stand on the table, so that the platform, which
    floats, seems to move the other way. That the reaction of the drive moves the part that stands
    still is the third of the three mechanisms by which a servo system errs in Rankers (Machine
    Dynamics in Mechatronic Systems, Twente, 1998; also Munnig Schmidt, Schitter, Rankers and
    van Eijk, The Design of High Performance Mechatronics, 2014). It rings on where the beam has
    stopped. A flight begins with the table at rest.

    4.2 N at 3 m/s^2 and 0.8 m over the feet are 3.4 N m: a table of 100 kg, 60 kg m^2, on feet of
    4.2 Hz leans by 80 urad and is turned at 0.06 rad/s^2, and more once it rings. 0.3 m off that is
    17 mm/s^2, or 0.14 N of 8.4 kg. J holds what the beam's height over the platform adds, as the
    table shakes it along x: m_b z_b h. What the platform's own motion does to the table is left
    out, as are the other ways in which it could move.
    """

    def __init__(
        self,
        inertia_kg_m2: float,
        freq_hz: float,
        damping: float,
        height_m: float,
        off_m: float,
        m_b_kg: float,
        mass_kg: float,
        j_kg_m2: float,
    ) -> None:
        for key, value in (("inertia_kg_m2", inertia_kg_m2), ("freq_hz", freq_hz)):
            if not value > 0.0:
                raise ValueError(f"{key}: expected a number above 0, found {value!r}")
        self.inertia_kg_m2, self.damping = inertia_kg_m2, damping
        self.height_m, self.off_m = height_m, off_m
        self.m_b_kg, self.mass_kg, self.j_kg_m2 = m_b_kg, mass_kg, j_kg_m2
        self._omega = 2.0 * math.pi * freq_hz

    def reset(self, plant: Any) -> None:
        self._dt_s, self._rate, self._angle = plant.dt_s, 0.0, None

    def wrench(self, t_s: float, q: Vector, qd: Vector, beam: Any) -> Vector:
        x, omega = beam.x_m, self._omega
        per_kg = self.m_b_kg / self.inertia_kg_m2
        if self._angle is None:
            self._angle = -per_kg * 9.81 * x / (omega * omega)
        turned = per_kg * (self.height_m * beam.a_m_s2 - 9.81 * x)
        turned -= omega * (2.0 * self.damping * self._rate + omega * self._angle)
        self._rate += self._dt_s * turned
        self._angle += self._dt_s * self._rate
        beam_kg_m = self.m_b_kg * (x + self.off_m)
        force = -(self.mass_kg * self.off_m + beam_kg_m) * turned
        return (0.0, -(self.j_kg_m2 + x * beam_kg_m) * turned, force)


class PassedCoil:
    """A coil pushes the beam's magnets too, as they pass over it: F = F (1 + e s), s of x_b alone.

    Coil and magnets are two dipoles, both upright, one c over the other and u c beside it. The
    force between them along z is 3 mu_0 m_1 m_2 / 2 pi c^4 times

        s = (1 - 3 u^2 / 2) / (1 + u^2)^(7/2),  u = (x_b - x_0) / c

    (Jackson, Classical Electrodynamics, 1999; Yung, Landecker and Villani, Magnetic and Electrical
    Separation 9 (1998) 39). It goes with the coil's current, hence with its force: what the coil
    gives per ampere depends on where the beam stands, and on the far side of u = 0.8 it is a
    little less than without a beam. The motor's magnets alternate, so that only what they do not
    cancel counts; x_0 is where that stands over the coil.

    8 N/A in 0.5 T are 16 m of wire, 170 turns of 15 mm radius: 0.11 A m^2 at the 0.95 A of rest.
    2 cm^3 of NdFeB, of 1.2 T, have 1.9 A m^2. 34 mm apart that is 0.1 N, of 7.63 N 1.3 %. The force
    is taken to act where the coil does; what it pulls sideways and tilts is left out. The magnets
    of the coil itself are on the platform, as the beam is: what those do to each other moves
    nothing.
    """

    def __init__(self, coil: int, share: float, at_m: float, apart_m: float) -> None:
        if not apart_m > 0.0:
            raise ValueError(f"apart_m: expected a number above 0, found {apart_m!r}")
        self.coil, self.share, self.at_m, self.apart_m = coil, share, at_m, apart_m

    def reset(self, plant: Any) -> None:
        # `coil_force` is asked before `wrench`, and knows the beam of the step before.
        self._factor = 1.0

    def coil_force(self, t_s: float, q: Vector, force_n: Any) -> Any:
        force_n[self.coil] *= self._factor
        return force_n

    def wrench(self, t_s: float, q: Vector, qd: Vector, beam: Any) -> Vector:
        square = ((beam.x_m - self.at_m) / self.apart_m) ** 2
        self._factor = 1.0 + self.share * (1.0 - 1.5 * square) / (1.0 + square) ** 3.5
        return (0.0, 0.0, 0.0)
