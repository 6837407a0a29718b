"""Describe the situation of a request to the planner, and refuse it with a remedy."""

from __future__ import annotations

from dataclasses import dataclass

from ..control.preflight_findings import Check
from ..control.states import State

RELOADED = (
    *(f"{may}_{who}" for may in ("allow", "stop", "watch") for who in ("users", "groups")),
    "client_gone",
)
"""Keys of the rig's `service` that may change while the daemon runs."""


class RefusedError(Exception):
    """Report that a request is refused, and why."""


@dataclass(frozen=True)
class Situation:
    """Describe the start of a plan: loop state, last setpoints of beam (m) and rotor (rad).

    `coils_known`: whether all coils passed the coil check.
    """

    state: State
    beam_m: float = 0.0
    rotor_rad: float = 0.0
    coils_known: bool = False


def wrong_state(found: State, wanted: State) -> str:
    """Return the refusal of a request that needs another state of the loop, with a remedy."""
    remedy = "land first: `levid land`"
    if found is State.FAULT:
        remedy = "`levid status` shows the fault; remove its cause, then run `levid clear`"
    elif found in (State.OFF, State.SELF_TEST):
        remedy = "the daemon prepares its devices; try again in a few seconds"
    elif wanted is State.LEVITATING:
        remedy = "lift off first: `levid levitate`" if found is State.IDLE else "wait for its end"
    return f"expected the state {wanted.name}, found {found.name}: {remedy}"


def override_hint(*checks: Check) -> str:
    """Return how a client flies in spite of failed checks, as the end of a refusal."""
    options = " ".join(f"--override {check}" for check in checks)
    return f". To fly all the same, at your own risk: {options}"
