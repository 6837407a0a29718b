"""Compute watchdog times from the cycle rate, the amplifier expiry and the free-fall time.

If the loop is lost, the coils keep the last force until the amplifiers expire; then the platform
falls. If the supervisor is lost, the loop still holds the platform, checks all limits, and lands.
"""

from __future__ import annotations

import math

from ...config.buses import AmplifierOptions
from ...config.rig import RigConfig

_G_M_S2 = 9.81


def fall_s(rig: RigConfig) -> float:
    """Return the free-fall time from the working point to `gap_m`, in s.

    A held force moves the platform no further in that time: on shipped rigs, `total_n` minus the
    weight is less than the weight.
    """
    own = rig.feedforward
    return math.sqrt(2.0 * rig.limits.gap_m / (_G_M_S2 if own is None else own.gravity_m_s2))


def expiry_cycles(rig: RigConfig) -> int | None:
    """Return how many cycles amplifiers hold a force; None if the backend has no such option."""
    amplifiers = rig.on_bus("amplifiers")
    if amplifiers is None or not isinstance(amplifiers[1], AmplifierOptions):
        return None
    return amplifiers[1].expire_cycles


def zero_after_s(rig: RigConfig) -> float | None:
    """Return the longest time from a lost loop's last command to zero force, in s.

    The command acts from the next cycle until it expires. None if the backend has no expiry.
    """
    cycles = expiry_cycles(rig)
    return None if cycles is None else (cycles + 1) / rig.rate_hz


def longest_stall(rig: RigConfig) -> int:
    """Return how many consecutive periods the loop may skip in flight.

    `limits.stall_s` if given. Otherwise the time until the amplifiers expire or a falling platform
    leaves its range, whichever is shorter; at least one period.
    """
    if rig.limits.stall_s is not None:
        return int(rig.limits.stall_s * rig.rate_hz)
    periods = int(fall_s(rig) * rig.rate_hz)
    cycles = expiry_cycles(rig)
    if cycles is not None:
        periods = min(periods, cycles - 1)
    return max(periods, 1)


def expiry_warning(rig: RigConfig) -> str:
    """Return a warning if amplifiers hold a lost loop's force too long; otherwise empty."""
    after_s, fall = zero_after_s(rig), fall_s(rig)
    if after_s is None or after_s <= fall:
        return ""
    cycles = int(fall * rig.rate_hz) - 1
    remedy = (
        f"set expire_cycles to at most {cycles}"
        if cycles >= 1
        else f"set rate_hz to at least {2.0 / fall:.0f}"
    )
    return (
        f"amplifiers.expire_cycles: if the loop is lost, its last force acts for "
        f"{1e3 * after_s:.0f} ms, but the platform may leave gap_m within "
        f"{1e3 * fall:.0f} ms: {remedy}"
    )
