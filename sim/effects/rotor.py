"""Rotor errors: imbalance, tilted axis."""

from __future__ import annotations

import math

from ..plant_arrays import GRAVITY_M_S2
from ..plant_kernels import Array
from .effect_interface import BeamState
from .places import positive

Wrench = tuple[float, float, float]


class RotorImbalance:
    """The bar's mass centre is off its axis by s / m, along the bar: s is its imbalance.

    Its torques on the platform are those of the weight, -g s (sin phi, cos phi), and of the
    reaction at the height z_r: z_r s times phi'' cos phi - phi'^2 sin phi (along y, for psi) and
    -phi'' sin phi - phi'^2 cos phi (along x, for theta). Along x the drives hold the beam.
    """

    def __init__(self, imbalance_kg_m: float, rotor_z_m: float) -> None:
        self.imbalance_kg_m, self.rotor_z_m = imbalance_kg_m, rotor_z_m

    def wrench(self, t_s: float, q: Array, qd: Array, beam: BeamState) -> Wrench:
        """Return the wrench in N m, N m, N."""
        c, s = math.cos(beam.phi_rad), math.sin(beam.phi_rad)
        towards, around = beam.phi_rad_s * beam.phi_rad_s, beam.phi_rad_s2
        z, g = self.rotor_z_m, GRAVITY_M_S2
        psi = z * (around * c - towards * s) - g * s
        theta = z * (-around * s - towards * c) - g * c
        return self.imbalance_kg_m * psi, self.imbalance_kg_m * theta, 0.0

    def beam_force(self, t_s: float, beam: BeamState, q: Array, qd: Array) -> float:
        """Return the force on the beam along x in N."""
        around, towards = beam.phi_rad_s2, beam.phi_rad_s * beam.phi_rad_s
        push = around * math.sin(beam.phi_rad) + towards * math.cos(beam.phi_rad)
        return self.imbalance_kg_m * push


class BarTorque:
    """The bar's axis is tilted by small angles, so its drive's torque J phi'' also acts on tilts.

    The torque on the platform is -J phi'' along the axis, which is tilted towards +x by
    `lean_x_rad` and towards +y by `lean_y_rad`: -J phi'' lean_x on psi (about +x) and
    + J phi'' lean_y on theta (about -y).
    """

    def __init__(self, j_kg_m2: float, lean_x_rad: float, lean_y_rad: float) -> None:
        positive(j_kg_m2=j_kg_m2)
        self._psi, self._theta = -j_kg_m2 * lean_x_rad, j_kg_m2 * lean_y_rad

    def wrench(self, t_s: float, q: Array, qd: Array, beam: BeamState) -> Wrench:
        """Return the wrench in N m, N m, N."""
        return self._psi * beam.phi_rad_s2, self._theta * beam.phi_rad_s2, 0.0
