"""Static sensor errors: gain, nonlinearity, crosstalk."""

from __future__ import annotations

from ..plant_kernels import Array
from .effect_interface import EffectPlant
from .places import Channel, chosen


class OnSensors:
    """Base of an effect on one sensor or on all; subclasses define the measured gap.

    Raises:
        ValueError: (in `reset`) the rig has no such sensor.
    """

    def __init__(self, sensor: Channel) -> None:
        self.sensor = sensor

    def reset(self, plant: EffectPlant) -> None:
        """Select the sensors."""
        self._count = len(plant.geometry.sensor_x_m)
        self._at = chosen(self.sensor, self._count, "sensor")
        self._dt_s = plant.dt_s

    def gap(self, t_s: float, gap_m: Array) -> Array:
        """Return the gaps as the sensors measure them, in m."""
        gap_m[self._at] = self.measured(t_s, gap_m[self._at])
        return gap_m

    def measured(self, t_s: float, gap_m: Array) -> Array:
        """Return the measured gaps in m of the affected sensors for the true `gap_m` at t_s."""
        raise NotImplementedError


class SensorGain(OnSensors):
    """y = (1 + excess) y: the sensor's gain differs from the nominal one."""

    def __init__(self, sensor: Channel, excess: float) -> None:
        super().__init__(sensor)
        self.excess = excess

    def measured(self, t_s: float, gap_m: Array) -> Array:
        """Return the measured gaps in m."""
        return (1.0 + self.excess) * gap_m


class SensorNonlinearity(OnSensors):
    """y = y / (1 + y / D): inductance is proportional to 1 / distance, with y small against D.

    The relative error is y / D: a smaller D is more nonlinear. D may be positive or negative.
    """

    def __init__(self, sensor: Channel, distance_m: float) -> None:
        super().__init__(sensor)
        if abs(distance_m) < 2e-3:
            raise ValueError(f"distance_m: expected 2 mm or more, found {distance_m!r} m")
        self.distance_m = distance_m

    def measured(self, t_s: float, gap_m: Array) -> Array:
        """Return the measured gaps in m."""
        return gap_m / (1.0 + gap_m / self.distance_m)


class SensorCrosstalk(OnSensors):
    """y = y + share y_other: coupling of two sensors' fields or wires."""

    def __init__(self, sensor: Channel, other: int, share: float) -> None:
        super().__init__(sensor)
        self.other, self.share = other, share

    def reset(self, plant: EffectPlant) -> None:
        """Select the sensors."""
        super().reset(plant)
        chosen(self.other, self._count, "other")

    def gap(self, t_s: float, gap_m: Array) -> Array:
        """Return the gaps as the sensors measure them, in m."""
        gap_m[self._at] += self.share * gap_m[self.other]
        return gap_m
