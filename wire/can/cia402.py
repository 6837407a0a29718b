"""Tables of CiA 402 drives: states, controlwords, objects and PDOs that levid uses."""

from __future__ import annotations

import math
import struct
from enum import Enum, IntEnum

from ...config.rig import Limits
from ..device_protocol import CYCLES, check_limit_fits

RPDO = struct.Struct("<Hi")
"""Setpoint to a drive: controlword, target position."""
TPDO = struct.Struct("<Hih")
"""Reading of a drive: statusword, actual position, actual force in 1/1000 of the rated force."""

POSITION_M, POSITION_RAD = 1e-9, 1e-7
ACCELERATION = 1e-3
"""Units of one count: m and m/s2 for linear motors, rad and rad/s2 for the rotary motor. Speeds are
in position counts per second."""
RATED = 1e-3
"""Unit of the rated force or torque, in N or N m."""

NMT_ID, SYNC_ID, EMERGENCY_ID, TPDO1_ID, RPDO1_ID = 0x000, 0x080, 0x080, 0x180, 0x200
SDO_ANSWER_ID, SDO_REQUEST_ID, HEARTBEAT_ID = 0x580, 0x600, 0x700
NODE_IDS = {
    "emergency": EMERGENCY_ID, "TPDO 1": TPDO1_ID, "RPDO 1": RPDO1_ID, "SDO answer": SDO_ANSWER_ID,
    "SDO request": SDO_REQUEST_ID, "heartbeat": HEARTBEAT_ID,
}  # fmt: skip
"""Frames of every node; the ID is this number plus the node number."""
SYNC_COUNTER = 240
"""A counted SYNC runs from 1 to this number and wraps."""


class Node(IntEnum):
    """NMT state in a heartbeat."""

    BOOT_UP = 0x00
    STOPPED = 0x04
    OPERATIONAL = 0x05
    PRE_OPERATIONAL = 0x7F

    @property
    def words(self) -> str:
        """The state in words, for messages."""
        return self.name.lower().replace("_", "-")


class Object(IntEnum):
    """Indices of the object dictionary."""

    DEVICE_TYPE = 0x1000
    HEARTBEAT_MS = 0x1017
    SYNC_OVERFLOW = 0x1019
    RPDO1 = 0x1400
    RPDO1_MAP = 0x1600
    TPDO1 = 0x1800
    TPDO1_MAP = 0x1A00
    ERROR_CODE = 0x603F
    CONTROLWORD = 0x6040
    STATUSWORD = 0x6041
    MODE = 0x6060
    MODE_DISPLAY = 0x6061
    ACTUAL_POSITION = 0x6064
    RATED_FORCE = 0x6076
    ACTUAL_FORCE = 0x6077
    TARGET_POSITION = 0x607A
    POSITION_LIMIT = 0x607D
    MAX_SPEED = 0x607F
    HOMING_METHOD = 0x6098
    INTERPOLATION = 0x60C2
    MAX_ACCELERATION = 0x60C5


EVENT_TIMER = 5
"""Subindex of the event timer in the parameters of a PDO."""
RPDO_MAPPING = ((Object.CONTROLWORD, 16), (Object.TARGET_POSITION, 32))
TPDO_MAPPING = (
    (Object.STATUSWORD, 16), (Object.ACTUAL_POSITION, 32), (Object.ACTUAL_FORCE, 16),
)  # fmt: skip
DEVICE_TYPE_DRIVE = 402
ENCODER_LOST, RPDO_TIMEOUT, FOLLOWING_ERROR = 0x7305, 0x8250, 0x8611
"""Error codes: encoder lost, no RPDO within the event timer, following error."""


class Mode(IntEnum):
    """Modes of operation."""

    HOMING = 6
    CYCLIC_SYNCHRONOUS_POSITION = 8


class DriveStates(Enum):
    """States of the drive; value: mask of the statusword, and the masked bits of the state."""

    NOT_READY = (0x4F, 0x00)
    SWITCH_ON_DISABLED = (0x4F, 0x40)
    READY_TO_SWITCH_ON = (0x6F, 0x21)
    SWITCHED_ON = (0x6F, 0x23)
    OPERATION_ENABLED = (0x6F, 0x27)
    QUICK_STOP_ACTIVE = (0x6F, 0x07)
    FAULT_REACTION = (0x4F, 0x0F)
    FAULT = (0x4F, 0x08)

    @property
    def words(self) -> str:
        """The state in words, for messages."""
        return self.name.lower().replace("_", " ")


DISABLE_VOLTAGE, SHUTDOWN, SWITCH_ON, ENABLE_OPERATION = 0x00, 0x06, 0x07, 0x0F
QUICK_STOP, FAULT_RESET, START_HOMING = 0x02, 0x80, 0x1F
TARGET_REACHED, HOMING_ATTAINED, HOMING_ERROR = 1 << 10, 1 << 12, 1 << 13

TOWARDS_OPERATION = {
    DriveStates.FAULT: FAULT_RESET,  # acts at its rising edge
    DriveStates.SWITCH_ON_DISABLED: SHUTDOWN,
    DriveStates.QUICK_STOP_ACTIVE: DISABLE_VOLTAGE,
    DriveStates.READY_TO_SWITCH_ON: SWITCH_ON,
    DriveStates.SWITCHED_ON: ENABLE_OPERATION,
}
"""Controlword of the next step towards OPERATION_ENABLED, for each state."""


def state_of(statusword: int) -> DriveStates | None:
    """Return the state of a statusword, None if CiA 402 does not define it."""
    for state in DriveStates:
        mask, value = state.value
        if statusword & mask == value:
            return state
    return None


def sync_counter(number: int) -> int:
    """Return the counter (1 to 240) of SYNC number `number`."""
    return number % SYNC_COUNTER + 1


def cycle_of_sync(counter: int, every: int) -> tuple[int, int]:
    """Return the cycle that begins with a counted SYNC, and the modulus of that cycle number.

    A SYNC is sent in every `every`-th cycle; cycles are counted modulo CYCLES.
    """
    modulus = math.gcd(SYNC_COUNTER * every, CYCLES)
    return (counter - 1) * every % modulus, modulus


def write_controlword(word: int) -> bytes:
    """Return the SDO request that writes a controlword: an expedited download of two bytes."""
    return _WRITE_16.pack(_DOWNLOAD_2, Object.CONTROLWORD, 0, word)


_WRITE_16 = struct.Struct("<BHBH2x")
_DOWNLOAD_2 = 0x2B


def beam_limits(limits: Limits) -> dict[tuple[Object, int], int]:
    """Return the limits in the drive of a linear motor: value of each (object, subindex)."""
    return {
        (Object.POSITION_LIMIT, 1): -round(limits.beam_m / POSITION_M),
        (Object.POSITION_LIMIT, 2): round(limits.beam_m / POSITION_M),
        (Object.MAX_SPEED, 0): round(limits.beam_velocity_m_s / POSITION_M),
        (Object.MAX_ACCELERATION, 0): round(limits.beam_acceleration_m_s2 / ACCELERATION),
    }


def check_limits_fit(limits: Limits) -> None:
    """Raise ConfigError for a limit that exceeds the 32 bits of its object in a drive."""
    check_limit_fits(limits, "beam_velocity_m_s", 1 / POSITION_M)
    check_limit_fits(limits, "beam_acceleration_m_s2", 1 / ACCELERATION)
    check_limit_fits(limits, "rotor_velocity_rad_s", 1 / POSITION_RAD)
    check_limit_fits(limits, "rotor_acceleration_rad_s2", 1 / ACCELERATION)


def rotor_limits(limits: Limits) -> dict[tuple[Object, int], int]:
    """Return the limits in the drive of the rotary motor: value of each (object, subindex)."""
    return {
        (Object.MAX_SPEED, 0): round(limits.rotor_velocity_rad_s / POSITION_RAD),
        (Object.MAX_ACCELERATION, 0): round(limits.rotor_acceleration_rad_s2 / ACCELERATION),
    }
