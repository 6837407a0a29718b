"""Worst-case time of a cycle on a serial port, for the bus budget."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from ...config.buses import RoleOptions
from ...config.rig import RigConfig
from ..bus_budget import BusTime
from .serial_frames import FrameContents


def serial_s(length: int, baud: float) -> float:
    """Return the time of `length` bytes in s, each with a start bit and a stop bit."""
    return 10 * length / baud


def bus_time(rig: RigConfig, name: str, roles: Mapping[str, RoleOptions], folder: Path) -> BusTime:  # noqa: ARG001
    """Return the time of a cycle on port `name` with these roles."""
    port, contents = rig.serial[name], FrameContents.of(rig, roles)
    # Setpoints start the cycle: they precede the answer, and nothing follows it.
    sent = serial_s(contents.on_wire(contents.cycle_bytes), port.baud)
    received = serial_s(contents.on_wire(contents.readings_bytes), port.baud)
    return BusTime(f"serial {name}", sent + received, 0.0, 0.0, port.latency_s)
