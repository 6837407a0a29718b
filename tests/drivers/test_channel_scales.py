"""Test the scales of single channels around devices, also where a reading is missing."""

from __future__ import annotations

import numpy as np
import pytest

from levid.config.rig import Channels
from levid.drivers.base import CoilAmplifiers, PositionSensors, StaleError
from levid.drivers.channel_scales import scaled_amplifiers, scaled_sensors

SCALE = (1.0, -1.0, 0.8)


class Amplifiers(CoilAmplifiers):
    def __init__(self) -> None:
        self.written = np.zeros(3)

    def write(self, coil_n):  # type: ignore[no-untyped-def]
        self.written = coil_n.copy()

    def read(self, coil_n):  # type: ignore[no-untyped-def]
        coil_n[:] = self.written


class Sensors(PositionSensors):
    def __init__(self, reading: list[float]) -> None:
        self.reading, self.missing = np.array(reading), False

    def read(self, gap_m):  # type: ignore[no-untyped-def]
        if self.missing:
            self.stale = self.STALE
            raise StaleError("no reading")
        gap_m[:] = self.reading


def test_commands_and_measured_forces_are_true_ones_outside() -> None:
    inside = Amplifiers()
    outside = scaled_amplifiers(inside, Channels(coil_scale=SCALE))
    outside.write(np.array([1.0, 2.0, 4.0]))
    assert inside.written.tolist() == [1.0, -2.0, 5.0]
    measured = np.zeros(3)
    outside.read(measured)
    np.testing.assert_allclose(measured, [1.0, 2.0, 4.0])
    outside.release(np.zeros(3))
    assert not inside.written.any()


def test_a_missing_reading_leaves_the_last_one() -> None:
    inside = Sensors([1e-4, -2e-4, 0.8e-4])
    outside = scaled_sensors(inside, Channels(sensor_scale=SCALE))
    gap = np.zeros(3)
    outside.read(gap)
    np.testing.assert_allclose(gap, [1e-4, 2e-4, 1e-4])
    inside.missing = True
    with pytest.raises(StaleError):
        outside.read(gap)
    np.testing.assert_allclose(gap, [1e-4, 2e-4, 1e-4])
    assert outside.stale == PositionSensors.STALE


def test_nothing_stands_between_where_all_scales_are_one() -> None:
    amplifiers, sensors = Amplifiers(), Sensors([0.0] * 3)
    for channels in (Channels(), Channels(coil_scale=(1.0,) * 3, sensor_scale=(1.0,) * 3)):
        assert scaled_amplifiers(amplifiers, channels) is amplifiers
        assert scaled_sensors(sensors, channels) is sensors


@pytest.mark.parametrize("scale", [0.0, 0.1, 6.0, float("nan")])
def test_a_scale_near_zero_is_rejected(scale: float) -> None:
    with pytest.raises(ValueError, match=r"scale|less|greater|finite"):
        Channels(coil_scale=(scale, 1.0, 1.0))
