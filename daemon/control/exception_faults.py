"""Which fault it is when something under the loop raises."""

from __future__ import annotations

from ...config.base import ConfigError
from ...drivers.base import AmplifierError, DriveError, LinkError, SensorError, StaleError
from .faults import Fault

_FAULT_OF: dict[type[Exception], Fault] = {
    LinkError: Fault.LINK,
    StaleError: Fault.STALE,
    AmplifierError: Fault.AMPLIFIER,
    SensorError: Fault.SENSOR,
    DriveError: Fault.DRIVE,
    # The simulated plant runs effects that users wrote: what fails there is no bus.
    ConfigError: Fault.SIMULATION,
}


def fault_of(error: Exception) -> tuple[Fault, str]:
    """Return the fault that an exception of devices or simulator is, and its cause in words."""
    for kind in type(error).__mro__:
        if kind in _FAULT_OF:
            return _FAULT_OF[kind], str(error)
    known = type(error).__module__.startswith("levid.")
    return Fault.DRIVER, str(error) if known else f"{type(error).__name__}: {error}"
