"""Undeclared masses: offset centre of mass, payload."""

from __future__ import annotations

import numpy as np

from ..plant_arrays import GRAVITY_M_S2
from ..plant_kernels import Array
from .effect_interface import BeamState


class CentreOfMass:
    """The platform's centre of mass (mass m_p) is at (x, y) instead of the middle.

    m_p y and m_p x couple psi and theta with z in the mass matrix (Steiner, Lagrange); the weight's
    torques are -m_p g y and -m_p g x. The change m_p x^2 of the inertias about O is of second order
    and neglected.
    """

    def __init__(self, m_p_kg: float, x_m: float, y_m: float) -> None:
        mx, my = m_p_kg * x_m, m_p_kg * y_m
        self._mass = np.array([[0.0, 0.0, my], [0.0, 0.0, mx], [my, mx, 0.0]])
        self._tau = [-GRAVITY_M_S2 * my, -GRAVITY_M_S2 * mx, 0.0]

    def mass(self, t_s: float) -> Array:
        """Return the addition to M in kg m^2, kg m, kg."""
        return self._mass

    def wrench(self, t_s: float, q: Array, qd: Array, beam: BeamState) -> list[float]:
        """Return the weight's torques in N m, N m, N."""
        return self._tau


class Payload:
    """A point mass on the platform at (x, y) from `begin_s` on, added without an impulse.

    It adds m [y, x, 1]^T [y, x, 1] to M and the weight -m g [y, x, 1].
    """

    def __init__(self, mass_kg: float, x_m: float, y_m: float, begin_s: float) -> None:
        at = np.array([y_m, x_m, 1.0])
        self._mass, self._tau = mass_kg * np.outer(at, at), -mass_kg * GRAVITY_M_S2 * at
        self._none, self._nothing = np.zeros((3, 3)), np.zeros(3)
        self.begin_s = begin_s

    def mass(self, t_s: float) -> Array:
        """Return the addition to M in kg m^2, kg m, kg."""
        return self._mass if t_s >= self.begin_s else self._none

    def wrench(self, t_s: float, q: Array, qd: Array, beam: BeamState) -> Array:
        """Return the weight's wrench in N m, N m, N."""
        return self._tau if t_s >= self.begin_s else self._nothing
