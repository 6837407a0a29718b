"""Check in every cycle that coils, beam and rotor report what they were commanded; compiled.

Backends report in cycle n what the command of cycle n - 2 causes: a command acts from the next
cycle on, and a reading is of the start of its cycle. Clocks of a bus may shift either by a cycle,
so commands of the cycles n - 3 to n - 1 count. A device follows them with a lag of at most the time
constant that the rig allows. Every first-order response with a shorter time constant stays between
`low` and `high`, which decay towards these commands with the longest one. A reading outside by more
than the channel's limit deviates, and several fresh readings in a row that deviate are a fault.

A drive that misses setpoints, because a cycle or a frame was late, goes on with its velocity: at
the velocity v it may also be ahead by v times its time constant.

While readings are missing, or amplifiers report missing setpoints, `low` and `high` do not decay:
the device may still follow an earlier command.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from ...log.cycle_codes import Fault
from ...log.signals import Stale

Array = NDArray[np.float64]

_SETTLING = 4
"""Cycles after opening or recovering the devices in which a reading extends `low` and `high`: the
devices may still follow commands from before."""
_HOLD = 3
"""Cycles after a missing reading or setpoint in which `low` and `high` do not decay."""
_MOST_HELD = 40
"""Consecutive cycles without decay. A device that misses setpoints for longer has to expire."""
_COILS_UNCONFIRMED = int(Stale.AMPLIFIERS | Stale.SETPOINTS)
_COILS_UNREAD, _DRIVES_UNREAD = int(Stale.AMPLIFIERS), int(Stale.DRIVES)

# Scalars: remaining cycles of settling; of coils and of drives the remaining and the past cycles
# without decay; the channel that deviates (-1: none), with command and reading.
_SETTLE, _COILS_HOLD, _COILS_HELD, _DRIVES_HOLD, _DRIVES_HELD, _WORST, _COMMAND, _READING = range(8)
# Of each channel: limit, decay in a cycle, readings in a row; the last two commands, bounds, count.
_LIMIT, _DECAY, _READINGS, _BEFORE, _EARLIER, _LOW, _HIGH, _COUNT = range(8)


def size(coils: int) -> int:
    """Return how many numbers the check keeps in the controller's memory."""
    return 8 * (coils + 3)


class FollowingCheck:
    """Set up the check of C coils, beam and rotor, and name the channel that deviates.

    Args:
        memory: array of `size` numbers, part of the controller's memory.
        limit: largest deviation of each channel (C + 2,): coils in N, beam in m, rotor in rad.
        lag_s: longest time constant of each channel (C + 2,) in s.
        readings: deviating readings in a row that are a fault (C + 2,).
        period_s: cycle period in s.
    """

    def __init__(
        self, memory: Array, limit: Array, lag_s: Array, readings: Array, period_s: float
    ) -> None:
        self._memory, self._channels = memory[:8], memory[8:].reshape(-1, 8)
        self._coils = len(limit) - 2
        self._limit = limit
        memory[:] = 0.0
        self._memory[_WORST] = -1.0
        self._channels[:, _DECAY] = np.exp(-period_s / lag_s)
        self._channels[:, _READINGS] = readings
        self._channels[:, _LIMIT] = math.inf  # until the devices are open

    def begin(self, reads_back: bool) -> None:
        """Begin to check devices that were opened or recovered.

        reads_back: whether the amplifiers measure the force; without, coils are not checked.
        """
        channels = self._channels
        channels[:, _LIMIT] = self._limit
        if not reads_back:
            channels[: self._coils, _LIMIT] = math.inf
        channels[:, _COUNT] = 0.0
        self._memory[_SETTLE] = _SETTLING

    def text(self, fault: Fault) -> str:
        """Return the channel that deviates, its command and its reading; empty for other faults."""
        worst, command, reading = self._memory[_WORST:]
        if fault is Fault.AMPLIFIER and 0 <= worst < self._coils:
            return f"coil {worst:.0f}: commanded {command:.2f} N, reads back {reading:.2f} N"
        if fault is Fault.DRIVE and worst == self._coils:
            position, setpoint = f"{1e3 * reading:.3f} mm", f"{1e3 * command:.3f} mm"
            return f"the beam is at {position}, its setpoint is {setpoint}"
        if fault is Fault.DRIVE and worst > self._coils:
            return f"the rotor is at {reading:.4f} rad, its setpoint is {command:.4f} rad"
        return ""


@njit(cache=True)
def check_following(  # type: ignore[no-untyped-def] # noqa: PLR0912 - one pass over the channels
    coil, readback, beam_m, beam_ref_m, rotor_rad, rotor_ref_rad, stale, judged, memory
) -> int:
    """Update the check with a cycle's readings; return the channel that deviates.

    0: none. Positive: number of the channel plus one, if it has deviated for as many readings as
    are a fault. Negative: likewise, if it deviates in this reading.

    `coil` (C,), `beam_ref_m` and `rotor_ref_rad` are the commands of the previous cycle. `stale`
    are the bits of the log field. Without `judged`, in a fault, readings are not judged.

    control_cycle contains the compiled code: touch its file after a change here.
    """
    n = coil.size
    channels = memory[8:].reshape(-1, 8)
    settling = memory[_SETTLE] > 0.0
    if settling:
        memory[_SETTLE] -= 1.0
    coils_hold = _holds(memory, _COILS_HOLD, (stale & _COILS_UNCONFIRMED) != 0)
    drives_hold = _holds(memory, _DRIVES_HOLD, (stale & _DRIVES_UNREAD) != 0)
    coils_judged = judged and not settling and (stale & _COILS_UNREAD) == 0
    drives_judged = judged and not settling and (stale & _DRIVES_UNREAD) == 0
    worst, most, fault = -1, 0.0, False
    for j in range(n + 2):
        if j < n:
            command, reading, hold, judge = coil[j], readback[j], coils_hold, coils_judged
        elif j == n:
            command, reading, hold, judge = beam_ref_m, beam_m, drives_hold, drives_judged
        else:
            command, reading, hold, judge = rotor_ref_rad, rotor_rad, drives_hold, drives_judged
        own = channels[j]
        before, earlier, limit = own[_BEFORE], own[_EARLIER], own[_LIMIT]
        if settling:
            before = earlier = command
        # Without new setpoints a drive goes on with its velocity: for its time constant at most.
        lead = abs(command - before) / (1.0 - own[_DECAY]) if j >= n else 0.0
        high = max(command + lead, before, earlier)
        low = min(command - lead, before, earlier)
        own[_EARLIER], own[_BEFORE] = before, command
        # Comparisons instead of max and min: they ignore nan.
        decay = 1.0 if hold else own[_DECAY]
        if not settling and own[_HIGH] > high:
            high += decay * (own[_HIGH] - high)
        if not settling and own[_LOW] < low:
            low += decay * (own[_LOW] - low)
        if settling and reading > high:
            high = reading
        if settling and reading < low:
            low = reading
        own[_HIGH], own[_LOW] = high, low
        if not judge:
            continue
        excess = max(reading - high, low - reading) / limit
        if not excess > 1.0:
            own[_COUNT] = 0.0
            continue
        own[_COUNT] += 1.0
        certain = own[_COUNT] >= own[_READINGS]
        if (certain and not fault) or (certain == fault and excess > most):
            worst, most, fault = j, excess, certain
            memory[_COMMAND], memory[_READING] = before, reading
    if judged:
        memory[_WORST] = worst
    if worst < 0:
        return 0
    return worst + 1 if fault else -worst - 1


@njit(cache=True)
def _holds(memory, at, unconfirmed):  # type: ignore[no-untyped-def]
    """Return whether bounds do not decay in this cycle; count such cycles from `at` on."""
    if unconfirmed and memory[at + 1] < _MOST_HELD:
        memory[at] = _HOLD
    if memory[at] > 0.0:
        memory[at] -= 1.0
        memory[at + 1] += 1.0
        return True
    if not unconfirmed:
        memory[at + 1] = 0.0
    return False
