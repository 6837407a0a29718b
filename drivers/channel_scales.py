"""Scale the commands and readings of single channels, as `channels` in RIG.yaml says."""

from __future__ import annotations

import numpy as np

from ..config.base import ConfigError
from ..config.rig import Channels, RigConfig
from .base import Array, CoilAmplifiers, PositionSensors


def scaled_amplifiers(amplifiers: CoilAmplifiers, channels: Channels) -> CoilAmplifiers:
    """Return the amplifiers, with true forces on their outside if a coil has a scale."""
    if all(scale == 1.0 for scale in channels.coil_scale):
        return amplifiers
    return _Amplifiers(amplifiers, np.array(channels.coil_scale))


def scaled_sensors(sensors: PositionSensors, channels: Channels) -> PositionSensors:
    """Return the sensors, with true heights on their outside if a sensor has a scale."""
    if all(scale == 1.0 for scale in channels.sensor_scale):
        return sensors
    return _Sensors(sensors, np.array(channels.sensor_scale))


def check_command_range(rig: RigConfig, most_n: float, whose: str) -> None:
    """Raise ConfigError if a coil's largest command, with its scale, exceeds a range of most_n."""
    found_n = rig.device_limits.coil_n
    if found_n > most_n:
        weak = found_n > rig.limits.coil_n
        why = f", for {rig.limits.coil_n:g} N of the weakest coil (channels.coil_scale)"
        raise ConfigError(
            f"limits.coil_n: expected at most {most_n:g} N, the range of {whose}, found "
            f"{found_n:g} N{why if weak else ''}"
        )


class _Amplifiers(CoilAmplifiers):
    def __init__(self, inside: CoilAmplifiers, scale: Array) -> None:
        self._inside, self._scale = inside, scale
        self._scaled = np.zeros(len(scale))

    def write(self, coil_n: Array) -> None:
        np.divide(coil_n, self._scale, out=self._scaled)
        self._inside.write(self._scaled)

    def read(self, coil_n: Array) -> None:
        # What is there stays if a reading is missing: it is scaled as readings are.
        np.divide(coil_n, self._scale, out=coil_n)
        try:
            self._inside.read(coil_n)
        finally:
            np.multiply(coil_n, self._scale, out=coil_n)
            self.stale = self._inside.stale

    def release(self, zero_n: Array) -> None:
        self._inside.release(zero_n)


class _Sensors(PositionSensors):
    def __init__(self, inside: PositionSensors, scale: Array) -> None:
        self._inside, self._scale = inside, scale

    def read(self, gap_m: Array) -> None:
        np.multiply(gap_m, self._scale, out=gap_m)
        try:
            self._inside.read(gap_m)
        finally:
            np.divide(gap_m, self._scale, out=gap_m)
            self.stale = self._inside.stale
