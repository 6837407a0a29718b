"""How large the logs of a flight may become."""

from __future__ import annotations

from ...config.rig import RigConfig
from ...log.message_array import MESSAGE_BYTES
from ...log.signals import cycle_dtype


def most_log_bytes(rig: RigConfig, cycles: int) -> int:
    """Return the bytes that the logs of so many cycles take without compression.

    Compressed they take a half to three quarters of it.
    """
    row = cycle_dtype(len(rig.geometry.coil_x_m), len(rig.geometry.sensors_x_m)).itemsize
    return cycles * (row + MESSAGE_BYTES)
