"""Vertical ground vibration: the base moves, and q is measured relative to it.

In the base's coordinates the ground acceleration w'' acts on the masses with -m w'': -m_total w''
on z and -m_b x_b w'' on theta. It does not act on rods, air, coils and sensors, which are fixed to
the base.
"""

from __future__ import annotations

import math

import numpy as np
from scipy.signal import butter, sosfilt

from ..plant_kernels import Array
from .effect_interface import BeamState, EffectPlant
from .places import positive

Wrench = tuple[float, float, float]


class GroundVibration:
    """Ground vibration; subclasses define w''. `mass_kg` is the levitated mass, with the beam."""

    def __init__(self, mass_kg: float, m_b_kg: float) -> None:
        positive(mass_kg=mass_kg)
        self.mass_kg, self.m_b_kg = mass_kg, m_b_kg

    def reset(self, plant: EffectPlant) -> None:
        """Store the step."""
        self._dt_s = plant.dt_s

    def wrench(self, t_s: float, q: Array, qd: Array, beam: BeamState) -> Wrench:
        """Return the wrench in N m, N m, N."""
        rise = self.acceleration(t_s)
        return 0.0, -self.m_b_kg * beam.x_m * rise, -self.mass_kg * rise

    def acceleration(self, t_s: float) -> float:
        """Return the mean w'' in m/s^2 over the step that begins at t_s."""
        raise NotImplementedError


class GroundTone(GroundVibration):
    """w'' = a sin(2 pi f t): a machine nearby."""

    def __init__(
        self, acceleration_m_s2: float, freq_hz: float, mass_kg: float, m_b_kg: float
    ) -> None:
        super().__init__(mass_kg, m_b_kg)
        self.acceleration_m_s2, self._omega = acceleration_m_s2, 2.0 * math.pi * freq_hz

    def acceleration(self, t_s: float) -> float:
        """Return w'' in m/s^2 at the step's middle."""
        return self.acceleration_m_s2 * math.sin(self._omega * (t_s + 0.5 * self._dt_s))


class GroundNoise(GroundVibration):
    """w'' is Gaussian noise of `rms_m_s2` through a Butterworth band-pass of fourth order.

    Raises:
        ValueError: the band is not 0 < low < high, or (in `reset`) it exceeds 1 / (2 dt).
    """

    def __init__(
        self, rms_m_s2: float, band_hz: tuple[float, float], mass_kg: float, m_b_kg: float
    ) -> None:
        super().__init__(mass_kg, m_b_kg)
        low, high = band_hz
        if not 0.0 < low < high:
            raise ValueError(f"band_hz: expected [low, high] with 0 < low < high, found {band_hz}")
        self.rms_m_s2, self.band_hz = rms_m_s2, (low, high)

    def reset(self, plant: EffectPlant) -> None:
        """Design the filter and start at rest."""
        super().reset(plant)
        self._rng = plant.rng
        sections = butter(2, self.band_hz, "bandpass", fs=1.0 / plant.dt_s, output="sos")
        # For white noise of RMS 1 the output RMS is the root of the impulse response's energy.
        impulse = np.zeros(math.ceil(20.0 / (self.band_hz[1] - self.band_hz[0]) / plant.dt_s))
        impulse[0] = 1.0
        self._scale = self.rms_m_s2 / float(np.linalg.norm(sosfilt(sections, impulse)))
        self._sections = [tuple(map(float, row[[0, 1, 2, 4, 5]])) for row in sections]
        self._state = [(0.0, 0.0) for _ in self._sections]

    def acceleration(self, t_s: float) -> float:
        """Return w'' in m/s^2; each step draws one sample, since large draws cause late cycles."""
        x = self._scale * float(self._rng.standard_normal())
        for j, (b0, b1, b2, a1, a2) in enumerate(self._sections):
            first, second = self._state[j]
            y = b0 * x + first
            self._state[j] = (b1 * x - a1 * y + second, b2 * x - a2 * y)
            x = y
        return x
