"""Errors in the beam's declared forces on the platform, and magnets of the base under the beam."""

from __future__ import annotations

import math

from ..plant_arrays import GRAVITY_M_S2
from ..plant_kernels import Array
from .effect_interface import BeamState, EffectPlant
from .places import positive

Wrench = tuple[float, float, float]


class BeamReaction:
    """The reaction to the beam's acceleration is (1 + excess) times m_b z_b a_b.

    Cause, for example: the drives' force acts at another height than the beam's centre of mass.
    """

    def __init__(self, excess: float, m_b_kg: float) -> None:
        self._excess_kg = excess * m_b_kg

    def reset(self, plant: EffectPlant) -> None:
        """Store the beam's height."""
        self._excess_kg_m = self._excess_kg * plant.geometry.beam_z_m

    def wrench(self, t_s: float, q: Array, qd: Array, beam: BeamState) -> Wrench:
        """Return the excess wrench in N m, N m, N."""
        return 0.0, self._excess_kg_m * beam.a_m_s2, 0.0


class BeamCoriolis:
    """The beam's Coriolis force on the tilting platform is (1 + excess) times 2 m_b v_b theta'."""

    def __init__(self, excess: float, m_b_kg: float) -> None:
        self._twice_kg = 2.0 * excess * m_b_kg

    def wrench(self, t_s: float, q: Array, qd: Array, beam: BeamState) -> Wrench:
        """Return the excess wrench in N m, N m, N."""
        force = -self._twice_kg * beam.v_m_s * float(qd[1])
        return 0.0, beam.x_m * force, force


class BeamGravity:
    """The torque of the beam's weight on theta is (1 + excess) times -m_b g x_b.

    Cause, for example: a wrong scale of the encoder that measures x_b.
    """

    def __init__(self, excess: float, m_b_kg: float) -> None:
        self._excess_n = excess * m_b_kg * GRAVITY_M_S2

    def wrench(self, t_s: float, q: Array, qd: Array, beam: BeamState) -> Wrench:
        """Return the excess wrench in N m, N m, N."""
        return 0.0, -self._excess_n * beam.x_m, 0.0


class MagnetField:
    """Magnets of the base attract the beam: F = A sin(2 pi x_b / p + phase), up, at x_b."""

    def __init__(self, amplitude_n: float, pitch_m: float, phase_rad: float = 0.0) -> None:
        positive(pitch_m=pitch_m)
        self.amplitude_n, self.phase_rad = amplitude_n, phase_rad
        self._wave_1_m = 2.0 * math.pi / pitch_m

    def wrench(self, t_s: float, q: Array, qd: Array, beam: BeamState) -> Wrench:
        """Return the wrench in N m, N m, N."""
        force = self.amplitude_n * math.sin(self._wave_1_m * beam.x_m + self.phase_rad)
        return 0.0, beam.x_m * force, force
