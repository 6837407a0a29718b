"""Number the states of the loop and the faults, as in the log fields `state` and `fault`."""

from __future__ import annotations

from enum import IntEnum


class State(IntEnum):
    """Number the states of the loop, as in the log field `state`."""

    OFF = 0
    IDLE = 1
    LEVITATING = 2
    EXCITING = 3
    MOVING = 4
    LANDING = 5
    FAULT = 6
    SELF_TEST = 7

    @property
    def meaning(self) -> str:
        """Meaning of the state as text."""
        return _MEANING[self]


_MEANING = {
    State.OFF: "not running",
    State.IDLE: "zero force commanded; readings are logged",
    State.LEVITATING: "rising to the working point, or holding it",
    State.EXCITING: "holding the working point during excitation",
    State.MOVING: "holding the working point while the manipulator moves",
    State.LANDING: "descending onto the stops",
    State.FAULT: "zero force commanded until the fault is cleared",
    State.SELF_TEST: "zero force commanded; the readings of all channels are checked",
}


class Fault(IntEnum):
    """Number the faults that end a flight, as in the log field `fault`."""

    NONE = 0
    READING = 1
    GAP = 2
    COMPUTATION = 3
    BEAM = 4
    DRIVER = 5
    LATE = 6
    SIMULATION = 7
    STALE = 8
    LINK = 9
    AMPLIFIER = 10
    SENSOR = 11
    DRIVE = 12
    STOPPED = 13
    SUPERVISOR = 14
    LOOP = 15
    SELF_TEST = 16
    SEQUENCE = 17
    POSE = 18
    VELOCITY = 19
    HEAT = 20
    COIL_CHECK = 21
    SOFTWARE = 22
