"""Dynamic sensor errors: drift, lag, frozen and sticking readings."""

from __future__ import annotations

import math

import numpy as np

from ..plant_kernels import Array
from .effect_interface import EffectPlant
from .places import Channel, positive
from .sensors import OnSensors


class SensorDrift(OnSensors):
    """y = y + y_0 (1 - exp(-t / T)): warm-up of electronics that are switched on at t = 0."""

    def __init__(self, sensor: Channel, offset_m: float, time_constant_s: float) -> None:
        super().__init__(sensor)
        positive(time_constant_s=time_constant_s)
        self.offset_m, self.time_constant_s = offset_m, time_constant_s

    def measured(self, t_s: float, gap_m: Array) -> Array:
        """Return the measured gaps in m."""
        return gap_m - self.offset_m * math.expm1(-t_s / self.time_constant_s)


class SensorLag(OnSensors):
    """tau y' = y_in - y: the demodulator's filter; exact for a gap that is linear within a step."""

    def __init__(self, sensor: Channel, lag_s: float) -> None:
        super().__init__(sensor)
        positive(lag_s=lag_s)
        self.lag_s = lag_s

    def reset(self, plant: EffectPlant) -> None:
        """Start in steady state."""
        super().reset(plant)
        self._decay = math.exp(-plant.dt_s / self.lag_s)
        self._behind = self.lag_s / plant.dt_s * (1.0 - self._decay)
        self._last_m: Array | None = None

    def measured(self, t_s: float, gap_m: Array) -> Array:
        """Return the measured gaps in m."""
        if self._last_m is None:
            self._last_m, self._lacks = gap_m, np.zeros(len(gap_m))
        self._lacks = self._decay * self._lacks + self._behind * (gap_m - self._last_m)
        self._last_m = gap_m
        return gap_m - self._lacks


class StuckSensor(OnSensors):
    """From `begin_s` on, alternate: frozen for `stuck_s`, then correct for `free_s`."""

    def __init__(self, sensor: Channel, begin_s: float, stuck_s: float, free_s: float) -> None:
        super().__init__(sensor)
        positive(stuck_s=stuck_s, free_s=free_s)
        self.begin_s, self.stuck_s, self.free_s = begin_s, stuck_s, free_s

    def reset(self, plant: EffectPlant) -> None:
        """Start with a correct reading."""
        super().reset(plant)
        self._held_m: Array | None = None

    def measured(self, t_s: float, gap_m: Array) -> Array:
        """Return the measured gaps in m."""
        since = t_s - self.begin_s
        sticks = since >= 0.0 and since % (self.stuck_s + self.free_s) < self.stuck_s
        if not sticks or self._held_m is None:
            self._held_m = gap_m
        return self._held_m


class StickingSensor(OnSensors):
    """The reading changes only when the gap differs by `step_m`: a probe with stiction."""

    def __init__(self, sensor: Channel, step_m: float) -> None:
        super().__init__(sensor)
        positive(step_m=step_m)
        self.step_m = step_m

    def reset(self, plant: EffectPlant) -> None:
        """Start with the true value."""
        super().reset(plant)
        self._shown_m: Array | None = None

    def measured(self, t_s: float, gap_m: Array) -> Array:
        """Return the measured gaps in m."""
        if self._shown_m is None:
            self._shown_m = gap_m
        moved = np.abs(gap_m - self._shown_m) >= self.step_m
        self._shown_m = np.where(moved, gap_m, self._shown_m)
        return self._shown_m
