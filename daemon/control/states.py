"""Allowed transitions between the states of the loop, and the states in flight."""

from __future__ import annotations

from ...log.cycle_codes import State

__all__ = ["IN_FLIGHT", "TRANSITIONS", "State", "may_become"]


def may_become(state: State, other: State) -> bool:
    """Return whether `other` is this state or an allowed successor."""
    return other is state or other in TRANSITIONS[state]


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
