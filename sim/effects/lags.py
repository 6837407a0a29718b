"""Dynamic errors of coil forces: lag, delay, thermal drift."""

from __future__ import annotations

import math
from collections import deque

import numpy as np

from ..plant_kernels import Array
from .coils import OnCoils
from .effect_interface import EffectPlant
from .places import Channel, positive


class ActuatorLag(OnCoils):
    """tau F' = F_in - F: eddy currents or a slow current loop, in addition to the nominal lag.

    Returns the mean over the step, exact for a force that is constant over it.
    """

    def __init__(self, coil: Channel, lag_s: float) -> None:
        super().__init__(coil)
        positive(lag_s=lag_s)
        self.lag_s = lag_s

    def reset(self, plant: EffectPlant) -> None:
        """Start with zero force."""
        super().reset(plant)
        ratio = plant.dt_s / self.lag_s
        self._decay, self._mean = math.exp(-ratio), -math.expm1(-ratio) / ratio
        self._force_n = np.zeros(len(self._at))

    def delivered(self, force_n: Array) -> Array:
        """Return the delivered forces in N."""
        lacks = self._force_n - force_n
        self._force_n = force_n + self._decay * lacks
        return force_n + self._mean * lacks


class ExtraDelay(OnCoils):
    """F(t) = F_in(t - delay): additional delay of a bus or a converter.

    Delays of a fraction of a step are exact for forces that are constant over each step.
    """

    def __init__(self, coil: Channel, delay_s: float) -> None:
        super().__init__(coil)
        if delay_s < 0.0:
            raise ValueError(f"delay_s: expected 0 or more, found {delay_s!r}")
        self.delay_s = delay_s

    def reset(self, plant: EffectPlant) -> None:
        """Start with zero delayed forces."""
        super().reset(plant)
        steps = self.delay_s / plant.dt_s
        # The margin makes 3e-4 / 1e-4 three whole steps despite rounding.
        whole = math.floor(steps + 1e-9)
        self._part = max(steps - whole, 0.0)
        self._way = deque([np.zeros(len(self._at))] * (whole + 2), maxlen=whole + 2)

    def delivered(self, force_n: Array) -> Array:
        """Return the delivered forces in N."""
        self._way.append(force_n)
        return self._part * self._way[0] + (1.0 - self._part) * self._way[1]


class ThermalDrift(OnCoils):
    """F = F (1 - loss w), T w' = (F / F_rated)^2 - w: magnets weaken with the coil's temperature.

    Copper loss is proportional to the current squared; w tends to 1 at constant F_rated.
    """

    def __init__(self, coil: Channel, loss: float, rated_n: float, time_constant_s: float) -> None:
        super().__init__(coil)
        positive(rated_n=rated_n, time_constant_s=time_constant_s)
        self.loss, self.rated_n, self.time_constant_s = loss, rated_n, time_constant_s

    def reset(self, plant: EffectPlant) -> None:
        """Start with cold coils."""
        super().reset(plant)
        self._rate = -math.expm1(-plant.dt_s / self.time_constant_s)
        self._warmth = np.zeros(len(self._at))

    def delivered(self, force_n: Array) -> Array:
        """Return the delivered forces in N."""
        load = force_n / self.rated_n
        self._warmth += self._rate * (load * load - self._warmth)
        return force_n * (1.0 - self.loss * self._warmth)
