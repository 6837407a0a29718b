"""A beam that shifts in its bearings: presliding (a yielding spring) and play (a gap)."""

from __future__ import annotations

from typing import Literal

import numpy as np

from ..plant_arrays import GRAVITY_M_S2
from ..plant_kernels import Array
from .effect_interface import BeamState, EffectPlant
from .friction import Springs
from .places import positive

_SPRINGS = 8


class _BeamInBearings:
    """The beam's shift in its bearings, along x (theta) or across, along y (psi).

    The encoders measure the carriage, and the drives' loops hold it; the beam shifts against the
    carriage without a measurement, so only the platform's motion shows it. With delta the beam's
    shift against the carriage, R the force of the bearing on the beam, and Y = delta - z_b theta
    its shift in space, whose equation does not contain the platform's angular acceleration,

        m_b Y'' = R - m_b g theta (- m_b a_b along x),   R = -F(delta, delta')
        tau_theta = z_b R - m_b g delta

    (for psi likewise). The plant includes a rigidly mounted beam: m_b z_b^2 in M, m_b g z_b in K
    and the reaction m_b z_b a_b are subtracted here, because R contains them.

    Y is integrated with semi-implicit Euler steps, accurate for sqrt(k / m_b) well below 1 / dt.
    Across the rails the effect is valid for both plant levels. Along x, the level `nonlinear` has
    the force of the platform's tilt on the beam's drive as for a rigid bearing.
    """

    def __init__(self, axis: Literal["x", "y"], m_b_kg: float) -> None:
        if axis not in ("x", "y"):
            raise ValueError(f"axis: expected x or y, found {axis!r}")
        positive(m_b_kg=m_b_kg)
        self._row = 1 if axis == "x" else 0
        self.m_b_kg = m_b_kg

    def reset(self, plant: EffectPlant) -> None:
        """Start with an unstrained bearing."""
        self._z_b, self._dt_s = plant.geometry.beam_z_m, plant.dt_s
        self._mass = np.zeros((3, 3))
        self._mass[self._row, self._row] = -self.m_b_kg * self._z_b**2
        self._shift_m: float | None = None
        self._speed_m_s, self._delta_m = 0.0, 0.0

    def wrench(self, t_s: float, q: Array, qd: Array, beam: BeamState) -> list[float]:
        """Advance the beam by a step; return the change of the wrench in N m, N m, N."""
        m, z_b, dt = self.m_b_kg, self._z_b, self._dt_s
        # Half a step of lead because the wrench is held over the step, see OnDof.
        tilt = float(q[self._row]) + 0.5 * dt * float(qd[self._row])
        if self._shift_m is None:
            self._shift_m, self._speed_m_s = -z_b * tilt, -z_b * float(qd[self._row])
        self._shift_m += dt * self._speed_m_s
        delta = self._shift_m + z_b * tilt
        rate = self._speed_m_s + z_b * float(qd[self._row])
        force = -self._bearing_n(self._delta_m, delta, rate)
        self._delta_m = delta
        along = m * beam.a_m_s2 if self._row == 1 else 0.0
        self._speed_m_s += dt * ((force - along) / m - GRAVITY_M_S2 * tilt)
        tau = [0.0, 0.0, 0.0]
        rigid = m * GRAVITY_M_S2 * z_b * tilt + z_b * along
        tau[self._row] = z_b * force - m * GRAVITY_M_S2 * delta - rigid
        return tau

    def mass(self, t_s: float) -> Array:
        """Return the change of M in kg m^2."""
        return self._mass

    def _bearing_n(self, before_m: float, delta_m: float, rate_m_s: float) -> float:
        """Return F in N at a shift and its rate, after a shift `before_m`."""
        raise NotImplementedError


class BearingPresliding(_BeamInBearings):
    """Presliding of the beam: F is a spring that yields gradually, and c delta'.

    The spring has the stiffness k for small shifts and slips at W: eight springs with slip
    displacements evenly spread from 0 to 2 W / k (Iwan 1966; measured on ball guides by Al-Bender
    and Symens 2005). W must exceed the force that the tilts require, some newtons; otherwise the
    beam slides away.
    """

    def __init__(
        self,
        axis: Literal["x", "y"],
        m_b_kg: float,
        stiffness_n_m: float,
        slip_n: float,
        damping_n_s_m: float,
    ) -> None:
        super().__init__(axis, m_b_kg)
        positive(stiffness_n_m=stiffness_n_m, slip_n=slip_n)
        self.damping_n_s_m = damping_n_s_m
        k = stiffness_n_m / _SPRINGS
        yields_m = 2.0 * slip_n / stiffness_n_m * (np.arange(_SPRINGS) + 0.5) / _SPRINGS
        self._springs = Springs([k] * _SPRINGS, (k * yields_m).tolist())

    def reset(self, plant: EffectPlant) -> None:
        """Start with an unstrained bearing."""
        super().reset(plant)
        self._springs.slacken()

    def _bearing_n(self, before_m: float, delta_m: float, rate_m_s: float) -> float:
        return self._springs.force(delta_m - before_m) + self.damping_n_s_m * rate_m_s


class BearingPlay(_BeamInBearings):
    """Play of the beam: it moves freely up to half the play from the middle.

    Beyond, F = k (delta -+ half) + c delta', which does not pull.
    """

    def __init__(
        self,
        axis: Literal["x", "y"],
        m_b_kg: float,
        play_m: float,
        stiffness_n_m: float,
        damping_n_s_m: float,
    ) -> None:
        super().__init__(axis, m_b_kg)
        positive(play_m=play_m, stiffness_n_m=stiffness_n_m)
        self.play_m, self.stiffness_n_m, self.damping_n_s_m = play_m, stiffness_n_m, damping_n_s_m

    def _bearing_n(self, before_m: float, delta_m: float, rate_m_s: float) -> float:
        half = 0.5 * self.play_m
        pressed = delta_m - min(max(delta_m, -half), half)
        if pressed == 0.0:
            return 0.0
        force = self.stiffness_n_m * pressed + self.damping_n_s_m * rate_m_s
        return force if force * pressed > 0.0 else 0.0
