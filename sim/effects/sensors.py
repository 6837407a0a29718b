"""Sensors that read otherwise than in proportion to their own gap, at once and without memory."""

from __future__ import annotations

from ..plant_kernels import Array
from .contract import EffectPlant
from .places import Channel, chosen


class OnSensors:
    """What happens at one sensor, or alike at all; subclasses say what they see.

    Raises ValueError in `reset` for a sensor that the rig has not.
    """

    def __init__(self, sensor: Channel) -> None:
        self.sensor = sensor

    def reset(self, plant: EffectPlant) -> None:
        """Look up which sensors are meant."""
        self._count = len(plant.geometry.sensor_x_m)
        self._at = chosen(self.sensor, self._count, "sensor")
        self._dt_s = plant.dt_s

    def gap(self, t_s: float, gap_m: Array) -> Array:
        """Return what the sensors really see, m."""
        gap_m[self._at] = self.seen(t_s, gap_m[self._at])
        return gap_m

    def seen(self, t_s: float, gap_m: Array) -> Array:
        """Return what the sensors at hand see of `gap_m` at t_s, m."""
        raise NotImplementedError


class SensorGain(OnSensors):
    """y = (1 + excess) y: a sensor whose slope is not the nominal one."""

    def __init__(self, sensor: Channel, excess: float) -> None:
        super().__init__(sensor)
        self.excess = excess

    def seen(self, t_s: float, gap_m: Array) -> Array:
        """Return what the sensors at hand see, m."""
        return (1.0 + self.excess) * gap_m


class SensorNonlinearity(OnSensors):
    """y = y / (1 + y / D): inductance falls as one over the distance, of which y is a small part.

    The error is the share y / D of the reading: the shorter D, the more bent. D has either sign.
    """

    def __init__(self, sensor: Channel, distance_m: float) -> None:
        super().__init__(sensor)
        if abs(distance_m) < 2e-3:
            raise ValueError(f"distance_m: expected 2 mm or more, found {distance_m!r} m")
        self.distance_m = distance_m

    def seen(self, t_s: float, gap_m: Array) -> Array:
        """Return what the sensors at hand see, m."""
        return gap_m / (1.0 + gap_m / self.distance_m)


class SensorCrosstalk(OnSensors):
    """y = y + share y_other: fields or wires of two sensors couple."""

    def __init__(self, sensor: Channel, other: int, share: float) -> None:
        super().__init__(sensor)
        self.other, self.share = other, share

    def reset(self, plant: EffectPlant) -> None:
        """Look up which sensors are meant."""
        super().reset(plant)
        chosen(self.other, self._count, "other")

    def gap(self, t_s: float, gap_m: Array) -> Array:
        """Return what the sensors really see, m."""
        gap_m[self._at] += self.share * gap_m[self.other]
        return gap_m
