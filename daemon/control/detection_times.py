"""Detection times: from the rate, the amplifiers' expiry, and how fast the platform falls.

A loop that is lost leaves the last force on the coils until the amplifiers expire by themselves;
from then on the platform falls. A supervisor that is lost leaves the loop, which goes on holding
the platform and watching all limits: it lands.
"""

from __future__ import annotations

import math

from ...config.buses import AmplifierOptions
from ...config.rig import RigConfig

_G_M_S2 = 9.81


def fall_s(rig: RigConfig) -> float:
    """Return how long the platform takes from the working point to gap_m, falling freely, in s.

    A force that is held leads no further in that time: what `total_n` leaves beside the weight is,
    on shipped rigs, less than the weight.
    """
    own = rig.feedforward
    return math.sqrt(2.0 * rig.limits.gap_m / (_G_M_S2 if own is None else own.gravity_m_s2))


def expiry_cycles(rig: RigConfig) -> int | None:
    """Return for how many cycles amplifiers hold a force; None where the backend does not say."""
    found = rig.on_bus("amplifiers")
    if found is None or not isinstance(found[1], AmplifierOptions):
        return None
    return found[1].expire_cycles


def zero_after_s(rig: RigConfig) -> float | None:
    """Return how long after its last command a lost loop's force is zero, at most, in s.

    The command acts from the next cycle on for as many as it holds. None where the backend does not
    say how long that is.
    """
    cycles = expiry_cycles(rig)
    return None if cycles is None else (cycles + 1) / rig.rate_hz


def longest_stall(rig: RigConfig) -> int:
    """Return how many periods in a row the loop may skip in flight.

    `limits.stall_s` if it is given. Else until the amplifiers have expired, or a falling platform
    would have left its range, whichever is first; a single one always.
    """
    if rig.limits.stall_s is not None:
        return int(rig.limits.stall_s * rig.rate_hz)
    most = int(fall_s(rig) * rig.rate_hz)
    cycles = expiry_cycles(rig)
    if cycles is not None:
        most = min(most, cycles - 1)
    return max(most, 1)


def held_too_long(rig: RigConfig) -> str:
    """Return a warning where amplifiers hold a lost loop's force for too long; empty if not."""
    after_s, fall = zero_after_s(rig), fall_s(rig)
    if after_s is None or after_s <= fall:
        return ""
    cycles = int(fall * rig.rate_hz) - 1
    mend = (
        f"expected expire_cycles of at most {cycles}"
        if cycles >= 1
        else f"expected a rate of at least {2.0 / fall:.0f} Hz"
    )
    return (
        f"amplifiers.expire_cycles: a lost loop's force acts for {1e3 * after_s:.0f} ms, and in "
        f"{1e3 * fall:.0f} ms the platform may leave gap_m: {mend}"
    )
