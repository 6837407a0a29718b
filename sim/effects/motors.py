"""Friction and cogging of the beam's linear motors.

These forces act between platform and beam, so they are internal. With `plant: declared` the beam
follows its setpoints exactly: the motors' force compensates them, they cancel on the platform, and
only the drives' force shows them. With `plant: nonlinear` the beam deviates slightly within the
drives' bandwidth, which acts on the platform through a_b.
"""

from __future__ import annotations

import math

from ..plant_kernels import Array
from .effect_interface import BeamState
from .places import positive


class MotorFriction:
    """F = -F_c tanh(v_b / v_0) - d v_b on the beam: rails and seals (Armstrong et al. 1994)."""

    def __init__(self, coulomb_n: float, speed_m_s: float, viscous_n_s_m: float = 0.0) -> None:
        positive(speed_m_s=speed_m_s)
        self.coulomb_n, self.speed_m_s = coulomb_n, speed_m_s
        self.viscous_n_s_m = viscous_n_s_m

    def beam_force(self, t_s: float, beam: BeamState, q: Array, qd: Array) -> float:
        """Return F in N."""
        v = beam.v_m_s
        return -self.coulomb_n * math.tanh(v / self.speed_m_s) - self.viscous_n_s_m * v


class MotorCogging:
    """F = A sin(2 pi x_b / p + phase) on the beam: teeth of the motor and its magnets, pitch p."""

    def __init__(self, amplitude_n: float, pitch_m: float, phase_rad: float = 0.0) -> None:
        positive(pitch_m=pitch_m)
        self.amplitude_n, self.phase_rad = amplitude_n, phase_rad
        self._wave_1_m = 2.0 * math.pi / pitch_m

    def beam_force(self, t_s: float, beam: BeamState, q: Array, qd: Array) -> float:
        """Return F in N."""
        return self.amplitude_n * math.sin(self._wave_1_m * beam.x_m + self.phase_rad)
