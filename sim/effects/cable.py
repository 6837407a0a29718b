"""Cables from the fixed frame: one hangs on the platform, one goes along with the beam."""

from __future__ import annotations

from ..plant_kernels import Array
from .contract import BeamState, EffectPlant


class HangingCable:
    """A constant vertical force at the point (x, y) of the platform, up positive.

    Nothing tells it from weights and offsets of the coils: see 'absorbed' in docs/effects.md.
    """

    def __init__(self, force_n: float, x_m: float, y_m: float) -> None:
        self._tau = [y_m * force_n, x_m * force_n, force_n]

    def wrench(self, t_s: float, q: Array, qd: Array, beam: BeamState) -> list[float]:
        """Return the wrench, N m, N m, N."""
        return self._tau


class BeamCable:
    """A cable to the moving beam: pulls it back by k x_b, and weighs on it by w x_b.

    The loops of the drives hold the beam where it is to be, so that the platform takes the pull,
    at the beam's height: tau_theta = z_b k x_b - w x_b^2, F_z = -w x_b. (A force F to +x at the
    height z_b turns it by -z_b F; an accelerating beam pushes it to -x, by + m_b z_b a_b.) The
    drives' force shows what they hold: k x_b.
    """

    def __init__(self, stiffness_n_m: float, weight_n_m: float) -> None:
        self.stiffness_n_m, self.weight_n_m = stiffness_n_m, weight_n_m

    def reset(self, plant: EffectPlant) -> None:
        """Take the beam's height."""
        self._z_b = plant.geometry.beam_z_m

    def wrench(
        self, t_s: float, q: Array, qd: Array, beam: BeamState
    ) -> tuple[float, float, float]:
        """Return the wrench, N m, N m, N."""
        x = beam.x_m
        weight = self.weight_n_m * x
        return 0.0, self._z_b * self.stiffness_n_m * x - weight * x, -weight

    def beam_force(self, t_s: float, beam: BeamState, q: Array, qd: Array) -> float:
        """Return the pull on the beam, N."""
        return -self.stiffness_n_m * beam.x_m
