"""States of the loop, as logged in every row, and the allowed transitions."""

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

    def may_become(self, other: State) -> bool:
        """Return whether `other` is this state or an allowed successor."""
        return other is self or other in TRANSITIONS[self]


_MEANING = {
    State.OFF: "not running",
    State.IDLE: "zero force; readings are logged",
    State.LEVITATING: "rising to the working point, or holding it",
    State.EXCITING: "holding the working point during excitation",
    State.MOVING: "holding the working point while the manipulator moves",
    State.LANDING: "descending onto the stops",
    State.FAULT: "zero force until the fault is cleared",
    State.SELF_TEST: "zero force; the readings of all channels are checked",
}

IN_FLIGHT = frozenset({State.LEVITATING, State.EXCITING, State.MOVING, State.LANDING})
"""States in which the coils carry the platform."""

_HOLDING = frozenset({State.LEVITATING, State.EXCITING, State.MOVING})

TRANSITIONS: dict[State, frozenset[State]] = {
    State.OFF: frozenset({State.SELF_TEST, State.FAULT}),
    State.SELF_TEST: frozenset({State.IDLE, State.FAULT, State.OFF}),
    State.IDLE: frozenset({State.LEVITATING, State.SELF_TEST, State.FAULT, State.OFF}),
    State.LEVITATING: (_HOLDING | {State.LANDING, State.FAULT}) - {State.LEVITATING},
    State.EXCITING: (_HOLDING | {State.LANDING, State.FAULT}) - {State.EXCITING},
    State.MOVING: (_HOLDING | {State.LANDING, State.FAULT}) - {State.MOVING},
    State.LANDING: frozenset({State.IDLE, State.FAULT}),
    State.FAULT: frozenset({State.SELF_TEST, State.OFF}),
}
"""Allowed successors of each state, used by code, tests and docs. The loop rejects all others."""
