"""The rotor on the beam: a bar that is not balanced, or whose axis is not quite upright."""

from __future__ import annotations

import math

from ..plant_arrays import GRAVITY_M_S2
from ..plant_kernels import Array
from .contract import BeamState
from .places import positive

Wrench = tuple[float, float, float]


class RotorImbalance:
    """The bar's mass centre is off its axis by s / m, along the bar: s is its imbalance.

    At the height z_r it turns the platform by its weight, -g s (sin phi, cos phi), and by its
    reaction, z_r s times its acceleration (phi'' cos phi - phi'^2 sin phi along y for psi,
    -phi'' sin phi - phi'^2 cos phi along x for theta). Along x the drives hold the beam against it.
    """

    def __init__(self, imbalance_kg_m: float, rotor_z_m: float) -> None:
        self.imbalance_kg_m, self.rotor_z_m = imbalance_kg_m, rotor_z_m

    def wrench(self, t_s: float, q: Array, qd: Array, beam: BeamState) -> Wrench:
        """Return the wrench, N m, N m, N."""
        c, s = math.cos(beam.phi_rad), math.sin(beam.phi_rad)
        towards, around = beam.phi_rad_s * beam.phi_rad_s, beam.phi_rad_s2
        z, g = self.rotor_z_m, GRAVITY_M_S2
        psi = z * (around * c - towards * s) - g * s
        theta = z * (-around * s - towards * c) - g * c
        return self.imbalance_kg_m * psi, self.imbalance_kg_m * theta, 0.0

    def beam_force(self, t_s: float, beam: BeamState, q: Array, qd: Array) -> float:
        """Return the push on the beam along x, N."""
        around, towards = beam.phi_rad_s2, beam.phi_rad_s * beam.phi_rad_s
        push = around * math.sin(beam.phi_rad) + towards * math.cos(beam.phi_rad)
        return self.imbalance_kg_m * push


class BarTorque:
    """The bar's axis leans by small angles: its drive's torque J phi'' turns the tilts too.

    The platform gets -J phi'' along the axis, which leans towards +x by `lean_x_rad` and towards +y
    by `lean_y_rad`: psi, about +x, gets -J phi'' lean_x, theta, about -y, + J phi'' lean_y.
    """

    def __init__(self, j_kg_m2: float, lean_x_rad: float, lean_y_rad: float) -> None:
        positive(j_kg_m2=j_kg_m2)
        self._psi, self._theta = -j_kg_m2 * lean_x_rad, j_kg_m2 * lean_y_rad

    def wrench(self, t_s: float, q: Array, qd: Array, beam: BeamState) -> Wrench:
        """Return the wrench, N m, N m, N."""
        return self._psi * beam.phi_rad_s2, self._theta * beam.phi_rad_s2, 0.0
