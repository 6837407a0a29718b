"""Cables from the fixed frame: to the platform, to the moving beam."""

from __future__ import annotations

from ..plant_kernels import Array
from .effect_interface import BeamState, EffectPlant


class HangingCable:
    """A constant vertical force at the point (x, y) of the platform, up positive.

    It is not distinguishable from weights and coil offsets, see 'absorbed' in docs/effects.md.
    """

    def __init__(self, force_n: float, x_m: float, y_m: float) -> None:
        self._tau = [y_m * force_n, x_m * force_n, force_n]

    def wrench(self, t_s: float, q: Array, qd: Array, beam: BeamState) -> list[float]:
        """Return the wrench in N m, N m, N."""
        return self._tau


class BeamCable:
    """A cable to the moving beam: it pulls the beam back with k x_b and loads it with w x_b.

    The drives hold the beam at its setpoint, so the pull acts on the platform at the beam's height:
    tau_theta = z_b k x_b - w x_b^2, F_z = -w x_b. (A force F along +x at the height z_b has the
    torque -z_b F; the reaction to an accelerating beam has + m_b z_b a_b.) The drives' force is
    k x_b.
    """

    def __init__(self, stiffness_n_m: float, weight_n_m: float) -> None:
        self.stiffness_n_m, self.weight_n_m = stiffness_n_m, weight_n_m

    def reset(self, plant: EffectPlant) -> None:
        """Store the beam's height."""
        self._z_b = plant.geometry.beam_z_m

    def wrench(
        self, t_s: float, q: Array, qd: Array, beam: BeamState
    ) -> tuple[float, float, float]:
        """Return the wrench in N m, N m, N."""
        x = beam.x_m
        weight = self.weight_n_m * x
        return 0.0, self._z_b * self.stiffness_n_m * x - weight * x, -weight

    def beam_force(self, t_s: float, beam: BeamState, q: Array, qd: Array) -> float:
        """Return the force on the beam in N."""
        return -self.stiffness_n_m * beam.x_m
