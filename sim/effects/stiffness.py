"""Nonlinear stiffness of the rods: cubic, quadratic, one-sided."""

from __future__ import annotations

from .places import Dof, OnDof


class CubicRods(OnDof):
    """F = -k3 s^3: rods stretch as they bend (Duffing 1918; Nayfeh and Mook 1979, 2.1)."""

    def __init__(self, dof: Dof, k3_n_m3: float) -> None:
        super().__init__(dof)
        self.k3_n_m3 = k3_n_m3

    def force(self, s: float, v: float) -> float:
        """Return F in N."""
        return -self.k3_n_m3 * s * s * s


class QuadraticRods(OnDof):
    """F = -k2 s^2: rods bent at rest are stiffer in one direction (Nayfeh and Mook 1979, 2.2)."""

    def __init__(self, dof: Dof, k2_n_m2: float) -> None:
        super().__init__(dof)
        self.k2_n_m2 = k2_n_m2

    def force(self, s: float, v: float) -> float:
        """Return F in N."""
        return -self.k2_n_m2 * s * s


class BilinearRods(OnDof):
    """F = -k s for s > 0, else 0: a contact on one side (Shaw and Holmes 1983)."""

    def __init__(self, dof: Dof, k_n_m: float) -> None:
        super().__init__(dof)
        self.k_n_m = k_n_m

    def force(self, s: float, v: float) -> float:
        """Return F in N."""
        return -self.k_n_m * s if s > 0.0 else 0.0
