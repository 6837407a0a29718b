"""What a planner and those who ask it share: the situation of a request, and its refusal."""

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


def override_hint(*checks: Check) -> str:
    """Return how a client flies in spite of failed checks, as the end of a refusal."""
    options = " ".join(f"--override {check}" for check in checks)
    return f". To fly all the same, at your own risk: {options}"
