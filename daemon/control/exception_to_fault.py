"""Map exceptions of drivers and simulator to faults."""

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
    # Raised by the simulated plant and its user-written effects.
    ConfigError: Fault.SIMULATION,
}


def fault_of(error: Exception) -> tuple[Fault, str]:
    """Return the fault for an exception of a driver or the simulator, and its detail text."""
    for kind in type(error).__mro__:
        if kind in _FAULT_OF:
            return _FAULT_OF[kind], str(error)
    own = type(error).__module__.startswith("levid.")
    return Fault.DRIVER, str(error) if own else f"{type(error).__name__}: {error}"
