"""Two more effects that no table of levid's has, by an eighth such author."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

Vector = Sequence[float]

_G_M_S2 = 9.81
# Of the common-mode power of three half bridges, what full modulation takes away.
_TAKEN = 4.0 / (math.sqrt(3.0) * math.pi)


class RockingTable:
    """The rig's table rocks as the beam pushes off: J_t u'' = m_b (h a_b - g x_b) - c u' - k u.

    u is the table's tilt, counted as theta, k = J_t (2 pi f)^2, c = 2 zeta J_t 2 pi f, h the beam's
    height over the axis that the table rocks about, z_b that over the platform's middle. What
    drives the beam pushes the platform back, the platform's rods push the base, and the base its
    table, which stands on air legs or on rubber: the reaction of a stage shakes the frame that it
    is measured against (Munnig Schmidt, Schitter, Rankers and van Eijk, The Design of High
    Performance Mechatronics, 2014; Rivin, Passive Vibration Isolation, 2003). Where the beam stands
    weighs on the table too. Coils and sensors go along with it, so that the platform feels

        tau_theta = -(J + m_b (z_b h + x_b^2)) u'' + m_b g z_b u,    F_z = -m_b x_b u'',

    J the platform's own inertia: it stays behind in turning, the beam also in what carries it up
    and along, as h over the axis any turning does; and on a tilted table the drive has to hold the
    beam's weight. Below f it follows the beam's acceleration and place, above f it takes a constant
    share of the reaction away, and after a start or a stop it rings: it depends on what the beam
    did for the last second or so. A flight begins with the table at rest.

    At 3 m/s^2 1.4 kg, 0.4 m over the axis, turn by 1.7 N m. A table of 120 kg that has 14 kg m^2
    goes off with 0.12 rad/s^2, and at 2 Hz by 0.8 mrad; the platform, 0.09 kg m^2 with what the
    beam has, gets 11 mN m. The platform's own swinging turns the table by a tenth of that, and is
    left out.
    """

    def __init__(
        self,
        table_j_kg_m2: float,
        freq_hz: float,
        damping: float,
        height_m: float,
        j_kg_m2: float,
        m_b_kg: float,
        z_b_m: float,
    ) -> None:
        for key, value in (("table_j_kg_m2", table_j_kg_m2), ("freq_hz", freq_hz)):
            if not value > 0.0:
                raise ValueError(f"{key}: expected a number above 0, found {value!r}")
        w = 2.0 * math.pi * freq_hz
        self.table_j_kg_m2, self.height_m = table_j_kg_m2, height_m
        self.j_kg_m2, self.m_b_kg, self.z_b_m = j_kg_m2, m_b_kg, z_b_m
        self._k_1_s2, self._c_1_s = w * w, 2.0 * damping * w

    def reset(self, plant: Any) -> None:
        self._dt_s = plant.dt_s
        self._tilt_rad: float | None = None
        self._rate_rad_s = 0.0

    def wrench(self, t_s: float, q: Vector, qd: Vector, beam: Any) -> Vector:
        m, x = self.m_b_kg, beam.x_m
        if self._tilt_rad is None:
            self._tilt_rad = -m * _G_M_S2 * x / (self.table_j_kg_m2 * self._k_1_s2)
        push = m * (self.height_m * beam.a_m_s2 - _G_M_S2 * x) / self.table_j_kg_m2
        tilt, rate = self._tilt_rad, self._rate_rad_s
        turning = push - self._c_1_s * rate - self._k_1_s2 * tilt
        self._rate_rad_s += self._dt_s * turning
        self._tilt_rad += self._dt_s * self._rate_rad_s
        j_kg_m2 = self.j_kg_m2 + m * (self.z_b_m * self.height_m + x * x)
        leans = m * _G_M_S2 * self.z_b_m * tilt
        return (0.0, leans - j_kg_m2 * turning, -m * x * turning)


class RectifiedDrive:
    """A sensor rectifies the switching of the rotor's drive: h = h - e 4 / (sqrt(3) pi) min(M, 1).

    M = |phi' + tau phi''| / W is how far the drive is modulated: the voltage that its motor needs,
    K phi' and what its winding takes, tau = R J / K^2, over what there is, W the speed that it ends
    at. Its three half bridges switch between the rails about a common centre, each for its share of
    a period, and their sum, the common-mode voltage, goes through the capacity of the motor's cable
    to whatever is grounded (Holmes and Lipo, Pulse Width Modulation for Power Converters, 2003). An
    amplifier cannot follow it, but its input stage bends, and shows the power of what is too fast
    for it as an offset (Kitchin, Counts and Gerstenhaber, Analog Devices AN-671, 2003). The three
    switch all at once, and most power is about, while the motor stands: the variance of the sum is
    U^2 (9 / 4 - M (c_1 - c_3)), c_1 and c_3 the largest and the least of three cosines 120 deg
    apart, on the mean 3 sqrt(3) / pi of each other; how that swings six times a turn of the field,
    by some percent, is left out. So the faster the rotor, either way, the less is there.

    e is the whole offset, which was zeroed with the drive on and the rotor at rest: 10 um, or 50 mV
    at 5 V/mm. A motor as for a camera's gimbal gets to 25 rad/s on its 12 V, so that 18 rad/s are
    72 % and the sensor reads 5.3 um too little; with 10 Ohm, 0.25 V s and 2e-4 kg m^2, tau is
    0.03 s. Above M = 1 the drive has nothing left. No force acts on the platform.
    """

    def __init__(
        self, sensor: int, offset_m: float, end_speed_rad_s: float, motor_s: float
    ) -> None:
        if not end_speed_rad_s > 0.0:
            raise ValueError(
                f"end_speed_rad_s: expected a number above 0, found {end_speed_rad_s!r}"
            )
        self.sensor, self.offset_m = sensor, offset_m
        self.end_speed_rad_s, self.motor_s = end_speed_rad_s, motor_s

    def reset(self, plant: Any) -> None:
        # `gap` is asked once before the first step, when the rotor is at rest.
        self._seen_m = 0.0

    def wrench(self, t_s: float, q: Vector, qd: Vector, beam: Any) -> Vector:
        needs_rad_s = abs(beam.phi_rad_s + self.motor_s * beam.phi_rad_s2)
        self._seen_m = -self.offset_m * _TAKEN * min(needs_rad_s / self.end_speed_rad_s, 1.0)
        return (0.0, 0.0, 0.0)

    def gap(self, t_s: float, gap_m: Any) -> Any:
        gap_m[self.sensor] += self._seen_m
        return gap_m
