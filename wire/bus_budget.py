"""Bus budget: the worst-case time of a cycle on each bus of a rig, and the highest rate that fits.

A cycle is SYNC, answers, control, setpoints. Answers on different buses overlap, and so do
setpoints, but setpoints follow answers. The period has to hold the longest answers plus the longest
setpoints, and on each bus all of its frames. Drives that are read in every n-th cycle only are not
waited for. Heartbeats and requests are neglected.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..config.backends import ROLES, find_backend, load_part
from ..config.base import ConfigError
from ..config.buses import RoleOptions
from ..config.rig import RigConfig

LONGEST_WAIT = 0.8
"""Largest share of a period in which the loop waits for answers."""
_NOTABLE_LATENCY_S = 1e-4
"""The error of a rate that does not fit names a latency above this."""


@dataclass(frozen=True)
class BusTime:
    """Worst-case time of a cycle on one bus, in s.

    The loop waits for `answers_s` and then `setpoints_s`. The frames of `unawaited_s` only occupy
    the bus; in some cycles `before_s` of them precede the answers and delay them.
    """

    name: str
    answers_s: float
    setpoints_s: float
    unawaited_s: float
    latency_s: float
    before_s: float = 0.0

    @property
    def answered_s(self) -> float:
        """Latest time of the last answer after the start of the cycle, latency included."""
        return self.before_s + self.answers_s + self.latency_s

    @property
    def busy_s(self) -> float:
        """Time in which the bus is busy in the fullest cycle, latency included."""
        return self.answers_s + self.setpoints_s + self.unawaited_s + self.latency_s


@dataclass(frozen=True)
class Budget:
    """Times of all buses of a rig; empty for a rig without buses."""

    buses: tuple[BusTime, ...]

    @property
    def cycle_s(self) -> float:
        """Shortest period that holds a cycle, 0 without buses."""
        if not self.buses:
            return 0.0
        answered_s = max(b.answered_s for b in self.buses)
        in_turn = answered_s + max(b.setpoints_s for b in self.buses)
        return max(in_turn, answered_s / LONGEST_WAIT, *(b.busy_s for b in self.buses))

    @property
    def rate_hz(self) -> int:
        """Highest rate that the buses carry."""
        return int(1.0 / self.cycle_s)


def budget(rig: RigConfig, folder: Path) -> Budget:
    """Return the budget of a rig; relative paths start in `folder`. Raises ConfigError."""
    on: dict[tuple[str, str], dict[str, RoleOptions]] = {}
    for role in ROLES:
        if (found := rig.on_bus(role)) is not None:
            backend, options = found
            on.setdefault((backend, options.bus), {})[role] = options
    return Budget(
        tuple(
            found(rig, name, roles, folder)
            for (backend, name), roles in on.items()
            if (found := _part(backend, "bus_time")) is not None
        )
    )


def check_budget(rig: RigConfig, folder: Path) -> Budget:
    """Return the budget of a rig.

    Raises:
        ConfigError: the rate is too high for the buses; the message names rates that fit.
    """
    found = budget(rig, folder)
    if found.cycle_s * rig.rate_hz <= 1.0:
        return found
    buses = ", ".join(map(_busy, found.buses))
    lines = [
        f"rate_hz: {rig.rate_hz:g} Hz is more than the buses carry: a cycle takes at most "
        f"{1e3 * found.cycle_s:.3f} ms ({buses}); the highest rate that fits is {found.rate_hz} Hz"
    ]
    raise ConfigError("; ".join([*lines, *_alternatives(rig, folder)]))


def _alternatives(rig: RigConfig, folder: Path) -> Iterator[str]:
    """Yield what the rig's backends suggest for a higher rate."""
    for backend in dict.fromkeys(getattr(rig, role).backend for role in ROLES):
        if (found := _part(backend, "alternatives")) is not None:
            yield from found(rig, folder)


def _part(backend: str, part: str) -> Any:
    descriptor = find_backend(backend)
    name = getattr(descriptor, part, None)
    return None if name is None else load_part(name, backend)


def _busy(bus: BusTime) -> str:
    notable = bus.latency_s > _NOTABLE_LATENCY_S
    latency = f", including latency_s of {1e3 * bus.latency_s:.3f} ms" if notable else ""
    return f"{bus.name} is busy for {1e3 * bus.busy_s:.3f} ms{latency}"
