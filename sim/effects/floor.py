"""Floor vibration: the base goes up and down, and with it everything that q is measured against.

In the base's coordinates the masses feel -m w'' for the floor's acceleration w'': -m_total w'' in z
and -m_b x_b w'' in theta. Rods, air, coils and sensors, all on the base, feel nothing of it.
"""

from __future__ import annotations

import math

import numpy as np
from scipy.signal import butter, sosfilt

from ..plant_kernels import Array
from .contract import BeamState, EffectPlant
from .places import positive

Wrench = tuple[float, float, float]


class Floor:
    """A floor with the acceleration that subclasses say; `mass_kg` is all that flies, beam too."""

    def __init__(self, mass_kg: float, m_b_kg: float) -> None:
        positive(mass_kg=mass_kg)
        self.mass_kg, self.m_b_kg = mass_kg, m_b_kg

    def reset(self, plant: EffectPlant) -> None:
        """Take the step."""
        self._dt_s = plant.dt_s

    def wrench(self, t_s: float, q: Array, qd: Array, beam: BeamState) -> Wrench:
        """Return what the masses feel, N m, N m, N."""
        rise = self.acceleration(t_s)
        return 0.0, -self.m_b_kg * beam.x_m * rise, -self.mass_kg * rise

    def acceleration(self, t_s: float) -> float:
        """Return w'' over the step that begins at t_s, m/s^2."""
        raise NotImplementedError


class FloorTone(Floor):
    """w'' = a sin(2 pi f t): a machine that runs nearby."""

    def __init__(
        self, acceleration_m_s2: float, freq_hz: float, mass_kg: float, m_b_kg: float
    ) -> None:
        super().__init__(mass_kg, m_b_kg)
        self.acceleration_m_s2, self._omega = acceleration_m_s2, 2.0 * math.pi * freq_hz

    def acceleration(self, t_s: float) -> float:
        """Return w'' at the step's middle, m/s^2."""
        return self.acceleration_m_s2 * math.sin(self._omega * (t_s + 0.5 * self._dt_s))


class FloorNoise(Floor):
    """w'' is Gaussian noise of `rms_m_s2` through a Butterworth band-pass of fourth order.

    Raises ValueError for a band that is not 0 < low < high, in `reset` for one beyond 1 / (2 dt).
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
        """Design the filter and begin with a floor at rest."""
        super().reset(plant)
        self._rng = plant.rng
        sections = butter(2, self.band_hz, "bandpass", fs=1.0 / plant.dt_s, output="sos")
        # White noise of rms 1 gives the square root of the response's energy; by then it is over.
        impulse = np.zeros(math.ceil(20.0 / (self.band_hz[1] - self.band_hz[0]) / plant.dt_s))
        impulse[0] = 1.0
        self._scale = self.rms_m_s2 / float(np.linalg.norm(sosfilt(sections, impulse)))
        self._sections = [tuple(map(float, row[[0, 1, 2, 4, 5]])) for row in sections]
        self._state = [(0.0, 0.0) for _ in self._sections]

    def acceleration(self, t_s: float) -> float:
        """Return w'', m/s^2: one number drawn and filtered, for bursts of many make late cycles."""
        x = self._scale * float(self._rng.standard_normal())
        for j, (b0, b1, b2, a1, a2) in enumerate(self._sections):
            first, second = self._state[j]
            y = b0 * x + first
            self._state[j] = (b1 * x - a1 * y + second, b2 * x - a2 * y)
            x = y
        return x
