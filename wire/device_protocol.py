"""States, requests and parameters of the electronics, the same on every bus."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Mapping, Sequence
from enum import IntEnum

from ..config.base import ConfigError
from ..config.rig import Limits, RigConfig

PROTOCOL = 1
"""Version of the frames; host and device must have the same version."""
CYCLES = 61_440
"""Modulus of the cycle number in frames: a multiple of 16 (counter of CAN frames) and of 240
(counter of SYNC)."""


class AmplifierState(IntEnum):
    """State of the coil amplifiers, in every frame of forces."""

    OFF = 0
    ENABLED = 1
    EXPIRED = 2
    TRIPPED = 3
    UNHEARD = 4
    """Enabled, but no setpoints for this cycle: the previous ones act until they expire."""


class SensorState(IntEnum):
    """State of the ADC, in every frame of readings."""

    OK = 0
    FAULTY = 1


class DriveState(IntEnum):
    """State of drives on a serial port, in every frame of readings."""

    OFF = 0
    HOMING = 1
    OPERATING = 2
    FAULT = 3


class Request(IntEnum):
    """Requests of the host, besides the cycle."""

    READ = 1
    ENABLE = 2
    RESET = 3
    ENABLE_DRIVES = 4


class Refusal(IntEnum):
    """Answers to a rejected request, in place of the parameter."""

    NO_SUCH_PARAMETER = 250
    WRONG_RESPONSE = 251
    STILL_TRIPPED = 252


class DeviceParameter(IntEnum):
    """Parameters that the host can read: 32 bits, unsigned, in the unit of the name."""

    PROTOCOL = 0
    COILS = 1
    SENSORS = 2
    PERIOD_NS = 3
    EXPIRE_CYCLES = 4
    COIL_LIMIT_MN = 5
    COIL_RATE_N_S = 6
    BEAM_LIMIT_UM = 7
    BEAM_SPEED_UM_S = 8
    BEAM_ACCELERATION_MM_S2 = 9
    ROTOR_SPEED_MRAD_S = 10
    ROTOR_ACCELERATION_MRAD_S2 = 11
    CHALLENGE = 16
    TRIPPED_COILS = 17
    FAULTY_SENSORS = 18
    DRIVE_ERROR = 19


AMPLIFIER_LIMITS = (
    DeviceParameter.PROTOCOL, DeviceParameter.COILS, DeviceParameter.PERIOD_NS,
    DeviceParameter.EXPIRE_CYCLES,
    DeviceParameter.COIL_LIMIT_MN, DeviceParameter.COIL_RATE_N_S,
)  # fmt: skip
SENSOR_LIMITS = (DeviceParameter.PROTOCOL, DeviceParameter.SENSORS, DeviceParameter.PERIOD_NS)
DRIVE_LIMITS = (
    DeviceParameter.PROTOCOL, DeviceParameter.PERIOD_NS, DeviceParameter.BEAM_LIMIT_UM,
    DeviceParameter.BEAM_SPEED_UM_S,
    DeviceParameter.BEAM_ACCELERATION_MM_S2, DeviceParameter.ROTOR_SPEED_MRAD_S,
    DeviceParameter.ROTOR_ACCELERATION_MRAD_S2,
)  # fmt: skip


_LARGEST = 0xFFFFFFFF
_LIMITS = {
    DeviceParameter.COIL_LIMIT_MN: ("coil_n", 1e3),
    DeviceParameter.COIL_RATE_N_S: ("coil_rate_n_s", 1.0),
    DeviceParameter.BEAM_LIMIT_UM: ("beam_m", 1e6),
    DeviceParameter.BEAM_SPEED_UM_S: ("beam_velocity_m_s", 1e6),
    DeviceParameter.BEAM_ACCELERATION_MM_S2: ("beam_acceleration_m_s2", 1e3),
    DeviceParameter.ROTOR_SPEED_MRAD_S: ("rotor_velocity_rad_s", 1e3),
    DeviceParameter.ROTOR_ACCELERATION_MRAD_S2: ("rotor_acceleration_rad_s2", 1e3),
}
"""Key in RIG.yaml of each limit, and the device's counts per SI unit."""


def expected_parameters(rig: RigConfig, expire_cycles: int) -> dict[DeviceParameter, int]:
    """Return the value that a device of this rig must have of every parameter below CHALLENGE."""
    geometry, limits = rig.geometry, rig.device_limits
    return {
        DeviceParameter.PROTOCOL: PROTOCOL,
        DeviceParameter.COILS: len(geometry.coil_x_m),
        DeviceParameter.SENSORS: len(geometry.sensors_x_m),
        DeviceParameter.PERIOD_NS: round(1e9 / rig.rate_hz),
        DeviceParameter.EXPIRE_CYCLES: expire_cycles,
        **{
            parameter: round(per_unit * getattr(limits, key))
            for parameter, (key, per_unit) in _LIMITS.items()
        },
    }


def check_limits_fit(rig: RigConfig, which: Sequence[DeviceParameter]) -> None:
    """Raise ConfigError for a limit that exceeds the 32 bits of a parameter."""
    for parameter in which:
        if parameter in _LIMITS:
            check_limit_fits(rig.device_limits, *_LIMITS[parameter])


def check_limit_fits(limits: Limits, key: str, per_unit: float) -> None:
    """Raise ConfigError if limit `key`, in the device's units, exceeds 32 bits."""
    value = getattr(limits, key)
    if round(per_unit * value) > _LARGEST:
        raise ConfigError(
            f"limits.{key}: expected at most {_LARGEST / per_unit:.6g}, the largest value of the "
            f"device protocol, found {value:g}"
        )


def response(challenge: int, limits: Mapping[DeviceParameter, int]) -> int:
    """Return the response to a challenge: CRC-32 of the challenge and all amplifier limits.

    A device whose limits differ from the host's is therefore never enabled.
    """
    words = [challenge, *(limits[parameter] for parameter in AMPLIFIER_LIMITS)]
    return zlib.crc32(struct.pack(f"<{len(words)}I", *words))
