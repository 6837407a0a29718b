"""Enable amplifiers on any bus: compare limits, answer the challenge, monitor their state."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np

from ..wire.device_protocol import (
    AMPLIFIER_LIMITS,
    AmplifierState,
    DeviceParameter,
    Refusal,
    Request,
    response,
)
from .base import AmplifierError, Array, DriverError

# sends request, index and value without waiting for the answer
Ask = Callable[[Request, int, int], None]
# sends request, index and value; returns index and value of the answer; raises DriverError
Exchange = Callable[[Request, int, int], tuple[int, int]]

_RETRY_CYCLES = 5
"""Cycles until an unanswered request for a challenge is repeated."""


def compare_limits(
    what: str,
    expected: Mapping[DeviceParameter, int],
    which: tuple[DeviceParameter, ...],
    exchange: Exchange,
) -> None:
    """Read the device's limits and compare them with the rig's.

    Raises:
        DriverError: limits differ; the message names each with both values.
    """
    wrong = []
    for parameter in which:
        index, found = exchange(Request.READ, parameter, 0)
        if index != parameter:
            wrong.append(f"{parameter.name}: the device does not have it")
        elif found != expected[parameter]:
            wrong.append(f"{parameter.name}: expected {expected[parameter]}, found {found}")
    if wrong:
        raise DriverError(f"{what}: limits of the device differ from RIG.yaml: {'; '.join(wrong)}")


def refusal(index: int) -> str:
    """Return the reason in brackets if `index` of an answer is a Refusal, else nothing."""
    return f" ({Refusal(index).name})" if index in _REFUSALS else ""


def worst_state(states: Sequence[int]) -> int:
    """Return the most severe of several amplifier states."""
    first = states[0]
    return first if all(s == first for s in states) else min(states, key=_WORST_FIRST.index)


class AmplifierWatch:
    """Enables amplifiers while zero force is commanded; detects if they switch off in flight."""

    def __init__(
        self, what: str, limits: Mapping[DeviceParameter, int], ask: Ask, tolerated: int
    ) -> None:
        self._what, self._ask = what, ask
        self._tolerated, self._lost_in_a_row = tolerated, 0
        self._limits = {p: limits[p] for p in AMPLIFIER_LIMITS}
        self._force_commanded = False
        self._state = AmplifierState.OFF
        self._cycles_to_retry = 0
        self._refused = ""
        self._reported = False

    def commanding(self, coil_n: Array) -> None:
        """Note the commanded forces (C,) in N."""
        self._force_commanded = bool(coil_n.any())

    def judge(self, state: int, force_n: Array) -> None:
        """Check the state received with `force_n` (C,) in N, where nan marks a tripped coil.

        nan becomes 0. An error is raised once: the loop continues to read during the fault.

        Raises:
            AmplifierError: the amplifiers tripped, are not enabled while force is commanded, or
                missed more than `tolerated` setpoints in a row.
        """
        if state == AmplifierState.UNHEARD:
            self._lost_in_a_row += 1
            if (
                self._lost_in_a_row > self._tolerated
                and self._force_commanded
                and not self._reported
            ):
                self._reported = True
                raise AmplifierError(
                    f"{self._what}: received no setpoints in {self._lost_in_a_row} cycles"
                )
            return
        self._lost_in_a_row = 0
        if state == AmplifierState.ENABLED:
            self._state, self._refused, self._reported = AmplifierState.ENABLED, "", False
            self._cycles_to_retry = 0  # if it switches off, request a challenge at once
            return
        was_enabled = self._state is AmplifierState.ENABLED
        tripped = np.flatnonzero(np.isnan(force_n))
        force_n[tripped] = 0.0
        self._state = AmplifierState(state) if state in _STATES else AmplifierState.OFF
        if self._state is not AmplifierState.TRIPPED and not self._force_commanded:
            if not self._reported:  # after a fault they stay off until it is cleared
                self._request_challenge()
            return
        if self._reported:
            return
        self._reported = True
        if self._state is AmplifierState.TRIPPED:
            coils = ", ".join(map(str, tripped)) or "unknown"
            raise AmplifierError(f"{self._what}: tripped, coil {coils}")
        if self._state is AmplifierState.EXPIRED:
            raise AmplifierError(f"{self._what}: setpoints expired, the force is zero")
        became = "switched off" if was_enabled else "are not enabled"
        raise AmplifierError(f"{self._what}: {became} while force is commanded{self._refused}")

    def answered(self, index: int, value: int) -> None:
        """Handle an answer of the device that arrived between readings."""
        if index == DeviceParameter.CHALLENGE:
            if self._reported or self._force_commanded:  # late: they must not be enabled now
                return
            self._ask(Request.ENABLE, 0, response(value, self._limits))
        elif index in _REFUSALS:
            self._refused = refusal(index)

    def reset(self, exchange: Exchange) -> None:
        """Reset trips after a fault; raises AmplifierError if the cause persists."""
        index, tripped = exchange(Request.RESET, 0, 0)
        if index not in (DeviceParameter.TRIPPED_COILS, Refusal.STILL_TRIPPED):
            raise AmplifierError(f"{self._what}: cannot reset trips{refusal(index)}")
        if index == Refusal.STILL_TRIPPED or tripped:
            coils = ", ".join(str(i) for i in range(32) if tripped >> i & 1)
            raise AmplifierError(f"{self._what}: still tripped, coil {coils}")
        self._reported, self._force_commanded, self._cycles_to_retry = False, False, 0

    def _request_challenge(self) -> None:
        """Request a challenge every _RETRY_CYCLES cycles until enabled."""
        self._cycles_to_retry -= 1
        if self._cycles_to_retry <= 0:
            self._cycles_to_retry = _RETRY_CYCLES
            self._ask(Request.READ, DeviceParameter.CHALLENGE, 0)


_STATES = frozenset(AmplifierState)
_WORST_FIRST = (
    AmplifierState.TRIPPED, AmplifierState.EXPIRED, *range(5, 16), AmplifierState.OFF,
    AmplifierState.UNHEARD, AmplifierState.ENABLED,
)  # fmt: skip
_REFUSALS = frozenset(Refusal)
