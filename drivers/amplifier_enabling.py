"""Host's side of amplifiers on any bus: limits compared, challenge answered, states watched."""

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

# asks a device: request, index, value; no answer is waited for
Ask = Callable[[Request, int, int], None]
# asks a device and returns index and value of its answer; raises DriverError
Exchange = Callable[[Request, int, int], tuple[int, int]]

_PATIENCE_CYCLES = 5
"""Cycles until a challenge that was not answered is asked for again."""


def compare_limits(
    what: str,
    expected: Mapping[DeviceParameter, int],
    which: tuple[DeviceParameter, ...],
    exchange: Exchange,
) -> None:
    """Read the device's limits and compare them with the rig's.

    Raises:
        DriverError: one differs; all that differ are named, with both values.
    """
    wrong = []
    for parameter in which:
        index, found = exchange(Request.READ, parameter, 0)
        if index != parameter:
            wrong.append(f"{parameter.name}: the device has none")
        elif found != expected[parameter]:
            wrong.append(f"{parameter.name}: expected {expected[parameter]}, found {found}")
    if wrong:
        raise DriverError(f"{what}: limits in the device are not the rig's: {'; '.join(wrong)}")


def refusal(index: int) -> str:
    """Return in brackets why a device refused, where the index of its answer says so."""
    return f" ({Refusal(index).name})" if index in _REFUSALS else ""


def worst_state(states: Sequence[int]) -> int:
    """Return the state that is told of several amplifiers: that of the one that is worst off."""
    first = states[0]
    return first if all(s == first for s in states) else min(states, key=_WORST_FIRST.index)


class AmplifierWatch:
    """Keeps amplifiers enabled while zero force is asked, and says when they are not in flight."""

    def __init__(
        self, what: str, limits: Mapping[DeviceParameter, int], ask: Ask, tolerated: int
    ) -> None:
        self._what, self._ask = what, ask
        self._tolerated, self._lost_in_a_row = tolerated, 0
        self._limits = {p: limits[p] for p in AMPLIFIER_LIMITS}
        self._commanded = False
        self._state = AmplifierState.OFF
        self._patience = 0
        self._refused = ""
        self._told = False

    def commanding(self, coil_n: Array) -> None:
        """Note what force is asked for, (C,) in N."""
        self._commanded = bool(coil_n.any())

    def judge(self, state: int, force_n: Array) -> None:
        """Look at the state that came with `force_n` (C,), where nan tells which coil tripped.

        nan becomes 0, and an error is raised once only: the loop goes on reading in the fault.

        Raises:
            AmplifierError: the amplifiers tripped, or are not enabled although force is asked, or
                more setpoints than `tolerated` did not come through in a row.
        """
        if state == AmplifierState.UNHEARD:
            self._lost_in_a_row += 1
            if self._lost_in_a_row > self._tolerated and self._commanded and not self._told:
                self._told = True
                raise AmplifierError(
                    f"{self._what}: setpoints did not come through in {self._lost_in_a_row} cycles"
                )
            return
        self._lost_in_a_row = 0
        if state == AmplifierState.ENABLED:
            self._state, self._refused, self._told = AmplifierState.ENABLED, "", False
            self._patience = 0  # should it switch off, it is asked at once
            return
        was_enabled = self._state is AmplifierState.ENABLED
        tripped = np.flatnonzero(np.isnan(force_n))
        force_n[tripped] = 0.0
        self._state = AmplifierState(state) if state in _STATES else AmplifierState.OFF
        if self._state is not AmplifierState.TRIPPED and not self._commanded:
            if not self._told:  # else it was a fault: they stay off until that is cleared
                self._pursue()
            return
        if self._told:
            return
        self._told = True
        if self._state is AmplifierState.TRIPPED:
            coils = ", ".join(map(str, tripped)) or "unknown"
            raise AmplifierError(f"{self._what}: tripped, coil {coils}")
        if self._state is AmplifierState.EXPIRED:
            raise AmplifierError(f"{self._what}: setpoints expired, they are at zero force")
        became = "switched off" if was_enabled else "are not enabled"
        raise AmplifierError(f"{self._what}: {became} while force is asked for{self._refused}")

    def answered(self, index: int, value: int) -> None:
        """Take an answer of the device that came between readings."""
        if index == DeviceParameter.CHALLENGE:
            if self._told or self._commanded:  # it comes late: nobody wants them enabled any more
                return
            self._ask(Request.ENABLE, 0, response(value, self._limits))
        elif index in _REFUSALS:
            self._refused = refusal(index)

    def reset(self, exchange: Exchange) -> None:
        """Reset trips after a fault; raises AmplifierError where the cause is not gone."""
        index, tripped = exchange(Request.RESET, 0, 0)
        if index not in (DeviceParameter.TRIPPED_COILS, Refusal.STILL_TRIPPED):
            raise AmplifierError(f"{self._what}: does not reset trips{refusal(index)}")
        if index == Refusal.STILL_TRIPPED or tripped:
            coils = ", ".join(str(i) for i in range(32) if tripped >> i & 1)
            raise AmplifierError(f"{self._what}: still tripped, coil {coils}")
        self._told, self._commanded, self._patience = False, False, 0

    def _pursue(self) -> None:
        """Ask for a challenge, now and then, until enabled."""
        self._patience -= 1
        if self._patience <= 0:
            self._patience = _PATIENCE_CYCLES
            self._ask(Request.READ, DeviceParameter.CHALLENGE, 0)


_STATES = frozenset(AmplifierState)
_WORST_FIRST = (
    AmplifierState.TRIPPED, AmplifierState.EXPIRED, *range(5, 16), AmplifierState.OFF,
    AmplifierState.UNHEARD, AmplifierState.ENABLED,
)  # fmt: skip
_REFUSALS = frozenset(Refusal)
