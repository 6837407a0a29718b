"""Which error the host must raise for each fault of the electronics, and words naming its cause."""

from __future__ import annotations

import re

from levid.drivers.base import (
    AmplifierError,
    DriveError,
    DriverError,
    LinkError,
    SensorError,
    StaleError,
)

EXPECTED: dict[str, tuple[tuple[type[DriverError], ...], str]] = {
    "drop": ((StaleError,), "received: nothing"),
    "drop-setpoints": ((AmplifierError,), "setpoints expired"),
    "delay": ((StaleError,), "too late"),
    "corrupt": ((StaleError,), "wrong checksum|invalid framing"),
    "repeat": ((StaleError,), "of another cycle|too late"),
    "reorder": ((StaleError,), "of another cycle"),
    "bus-off": ((LinkError, StaleError), "the controller is bus-off|^serial .*received: nothing"),
    "disconnect": ((StaleError, LinkError), "received: nothing|lost"),
    "stuck 4": ((SensorError,), "sensor 4: no reading"),
    "frozen 6": ((SensorError,), "sensor 6: frozen"),
    "saturated 2": ((SensorError,), "sensor 2: at the end of its range"),
    "trip 3": ((AmplifierError,), "tripped, coil 3"),
    "encoder phi": ((DriveError,), "0x7305"),
    "skew 0.001": ((DriveError,), "X1 and X2 .* found 1.000 mm"),
}
"""By the line that injects it."""
UNHEARD = ("drop-setpoints", "bus-off", "disconnect")
"""Nothing that the host sends gets through: the device's own expiry alone ends the force."""
NO_FAULT_OF_A_DEVICE = {"push"}
"""What pushes the platform: control has to hold it, or say so."""


def names(error: DriverError | None, line: str) -> bool:
    """Return whether an error names the fault that this line injected."""
    kinds, words = EXPECTED[line]
    return isinstance(error, kinds) and re.search(words, str(error)) is not None
