"""The states of the loop, as logged in every record."""

from __future__ import annotations

from enum import IntEnum


class State(IntEnum):
    """What the loop is doing; the number is the log's field `state`."""

    OFF = 0
    IDLE = 1
    LEVITATING = 2
    EXCITING = 3
    MOVING = 4
    LANDING = 5
    FAULT = 6

    @property
    def meaning(self) -> str:
        """What the state means, in words."""
        return _MEANING[self]


_MEANING = {
    State.OFF: "not running",
    State.IDLE: "zero force, readings are taken",
    State.LEVITATING: "rising to the working point, or holding it",
    State.EXCITING: "holding the working point while excitation plays",
    State.MOVING: "holding the working point while the manipulator moves",
    State.LANDING: "sinking onto the stops",
    State.FAULT: "zero force until the fault is cleared",
}
