"""Nonlinear air damping: quadratic drag, squeeze film."""

from __future__ import annotations

import numpy as np

from ..plant_kernels import Array
from .effect_interface import BeamState, EffectPlant
from .places import Dof, OnDof, coil_shapes, positive


class QuadraticDamping(OnDof):
    """F = -d2 |v| v: drag of a turbulent flow (Bernoulli; Nayfeh and Mook 1979, 3.3)."""

    def __init__(self, dof: Dof, d2_n_s2_m2: float) -> None:
        super().__init__(dof)
        self.d2_n_s2_m2 = d2_n_s2_m2

    def force(self, s: float, v: float) -> float:
        """Return F in N."""
        return -self.d2_n_s2_m2 * abs(v) * v


class SqueezeFilm:
    """Film of air under each coil, squeezed between flat faces: F_i = -d v_i (g / (g + h_i))^3.

    g is its thickness at the working point, h_i and v_i the coil's height and speed there, d the
    damping at h = 0: Reynolds' equation of an incompressible film (Stefan 1874; Bao and Yang, Sens.
    Actuators A 136 (2007) 3). Its constant part adds to the linear damping. The smallest thickness
    is a tenth of g, because the faces are rough.
    """

    def __init__(self, d_n_s_m: float, film_m: float) -> None:
        positive(film_m=film_m)
        self.d_n_s_m, self.film_m = d_n_s_m, film_m

    def reset(self, plant: EffectPlant) -> None:
        """Store the coils' positions."""
        self._shapes = coil_shapes(plant.geometry)
        self._to_wrench = -self.d_n_s_m * self._shapes.T

    def wrench(self, t_s: float, q: Array, qd: Array, beam: BeamState) -> Array:
        """Return the sum over the coils in N m, N m, N."""
        thickness = np.maximum(1.0 + (self._shapes @ q) / self.film_m, 0.1)
        return np.asarray(
            self._to_wrench @ ((self._shapes @ qd) / (thickness * thickness * thickness))
        )
