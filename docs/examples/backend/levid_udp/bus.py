"""Keys of a UDP bus in RIG.yaml, and the time of a cycle on it."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated

from pydantic import Field

from levid.config.base import NonNegative
from levid.config.buses import Bus, Cycles, Name, RoleOptions
from levid.config.rig import RigConfig
from levid.wire.bus_budget import BusTime

from .frames import Frames

_OVERHEAD_BYTES = 66
"""UDP and IP headers (28), Ethernet header, checksum, preamble and gap (38)."""


class UdpBus(Bus):
    """Address of the electronics; RIG.yaml has these keys under `udp: {NAME: ...}`."""

    host: Name
    port: Annotated[int, Field(ge=1, le=65535)]
    bitrate: Annotated[int, Field(ge=1_000_000)] = 100_000_000
    latency_s: NonNegative = 2e-4
    """Time that both network stacks add to a cycle."""
    stale_cycles: Cycles = 2

    @property
    def place(self) -> str:
        """Text that is equal for two sections that name the same electronics."""
        return f"{self.host}:{self.port}"


def bus_time(rig: RigConfig, name: str, roles: Mapping[str, RoleOptions], folder: Path) -> BusTime:  # noqa: ARG001
    """Return the worst-case time of a cycle: one packet out, one back."""
    bus: UdpBus = rig.buses["udp"][name]
    frames = Frames.of(rig)
    sent, received = (
        8 * (length + _OVERHEAD_BYTES) / bus.bitrate
        for length in (frames.cycle_bytes, frames.readings_bytes)
    )
    return BusTime(
        name=f"udp {name}",
        answers_s=sent + received,
        setpoints_s=0.0,
        unawaited_s=0.0,
        latency_s=bus.latency_s,
    )
