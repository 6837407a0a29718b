"""Test that the layout of the controller's memory is that of the compiled checks."""

from __future__ import annotations

import pytest

from levid.daemon.control.controller_memory import following_size, sensor_checks_size
from levid.daemon.control.following_check import size
from levid.daemon.control.sensor_checks import checks_size


@pytest.mark.parametrize("channels", [3, 9, 20])
def test_sizes_are_those_of_the_compiled_checks(channels: int) -> None:
    assert following_size(channels) == size(channels)
    assert sensor_checks_size(channels) == checks_size(channels)
