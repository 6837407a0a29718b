"""Limits that a device could not be told are refused before anything is opened."""

from __future__ import annotations

from typing import Any

import pytest

from levid.config.base import ConfigError
from levid.config.rig import Channels, RigConfig, load_rig
from levid.config.shipped import shipped
from levid.drivers.base import Context
from levid.drivers.open_backends import check_backends
from levid.wire.device_protocol import PROTOCOL, DeviceParameter, expected_parameters


def rig(kind: str, **limits: float) -> RigConfig:
    found = load_rig(shipped(f"rigs/{kind}.yaml"))
    return found.model_copy(update={"limits": found.limits.model_copy(update=limits)})


def checked(found: RigConfig) -> Any:
    return check_backends(Context(found, 1 / found.rate_hz, shipped("rigs/can.yaml").parent))


@pytest.mark.parametrize(
    ("kind", "key", "value", "most"),
    [
        ("serial", "coil_rate_n_s", 1e12, "4.29497e+09"),
        ("serial", "rotor_velocity_rad_s", 1e7, "4.29497e+06"),
        ("canfd", "coil_rate_n_s", 4_294_967_296.0 + 40_000, "4.29497e+09"),
        # Nanometres a second, and tenths of a microradian: objects of CiA 402.
        ("canfd", "beam_velocity_m_s", 5.0, "4.29497"),
        ("canfd", "rotor_velocity_rad_s", 500.0, "429.497"),
    ],
)
def test_limit_beyond_a_devices_words_is_refused(
    kind: str, key: str, value: float, most: str
) -> None:
    with pytest.raises(ConfigError) as error:
        checked(rig(kind, **{key: value}))
    assert str(error.value).startswith(f"limits.{key}: expected at most {most}, ")


def test_limit_that_no_device_is_told_may_be_anything() -> None:
    checked(rig("loopback", coil_rate_n_s=1e12, rotor_velocity_rad_s=1e7))


def test_shipped_rigs_tell_their_limits() -> None:
    told = expected_parameters(load_rig(shipped("rigs/serial.yaml")), 5)
    assert told[DeviceParameter.PROTOCOL] == PROTOCOL
    assert all(0 <= value < 2**32 for value in told.values())


@pytest.mark.parametrize(("kind", "most"), [("serial", "the serial protocol"), ("can", "DBC")])
def test_weak_coil_needs_more_of_the_range(kind: str, most: str) -> None:
    """A coil that gives half of its command is commanded twice the force, as fast."""
    found = rig(kind, coil_n=20.0, coil_rate_n_s=1e4)
    weak = Channels(coil_scale=(1.0,) * 8 + (-0.5,))
    told = expected_parameters(found.model_copy(update={"channels": weak}), 5)
    assert told[DeviceParameter.COIL_LIMIT_MN] == 40_000
    assert told[DeviceParameter.COIL_RATE_N_S] == 20_000
    weak = Channels(coil_scale=(1.0,) * 8 + (0.2,))
    with pytest.raises(ConfigError, match="found 100 N, for 20 N of the weakest coil") as error:
        checked(found.model_copy(update={"channels": weak}))
    assert most in str(error.value)
