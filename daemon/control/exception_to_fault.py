"""Map exceptions of drivers, simulator and software to faults.

A device fault sends somebody to cables and supplies: only what a device reported may become one.
"""

from __future__ import annotations

import sys
from types import TracebackType

from ...config.base import ConfigError
from ...drivers.base import (
    AmplifierError,
    DriveError,
    DriverError,
    LinkError,
    SensorError,
    StaleError,
)
from .faults import Fault

_FAULT_OF: dict[type[Exception], Fault] = {
    LinkError: Fault.LINK,
    StaleError: Fault.STALE,
    AmplifierError: Fault.AMPLIFIER,
    SensorError: Fault.SENSOR,
    DriveError: Fault.DRIVE,
    DriverError: Fault.DRIVER,
    # Raised by the simulated plant and its user-written effects.
    ConfigError: Fault.SIMULATION,
}
_DRIVERS = ("levid.drivers.", "levid.wire.")
_NO_DEVICE = frozenset(
    (
        *("cantools", "click", "foxglove", "jinja2", "levid", "llvmlite", "lz4", "matplotlib"),
        *("mcap", "msgpack", "numba", "numpy", "prometheus_client", "pydantic", "pydantic_core"),
        *("rich", "scipy", "textual", "threadpoolctl", "yaml", "zstandard"),
        *sys.stdlib_module_names,
    )
)
"""Packages whose errors are never those of a device. Backends and their libraries are the rest."""


def fault_of(error: Exception) -> tuple[Fault, str]:
    """Return the fault for an exception in the loop, and its detail text.

    An exception that is no DriverError is a device's if a backend let it through from the operating
    system (OSError) or from a package for devices, such as `can.CanError`; else it is SOFTWARE.
    """
    for kind in type(error).__mro__:
        if kind in _FAULT_OF:
            return _FAULT_OF[kind], str(error)
    own = type(error).__module__.startswith("levid.")
    detail = str(error) if own else f"{type(error).__name__}: {error}"
    if _is_of_device(error):
        return Fault.DRIVER, detail
    return Fault.SOFTWARE, f"{detail}{_place(error.__traceback__)}"


def _is_of_device(error: Exception) -> bool:
    """Return whether a backend raised the error, as far as it can be a device's."""
    package = type(error).__module__.partition(".")[0]
    foreign = package not in _NO_DEVICE
    if not (foreign or isinstance(error, OSError)):
        return False
    modules = list(_modules(error.__traceback__))
    # A backend may itself use what loads files and compiles.
    raised_by = next((m for m in reversed(modules) if not _is_standard(m)), "")
    return _is_backend(raised_by) or (foreign and any(map(_is_backend, modules)))


def _place(traceback: TracebackType | None) -> str:
    """Return file and line where an error was raised, for the report of a defect."""
    if traceback is None:
        return ""
    while traceback.tb_next is not None:
        traceback = traceback.tb_next
    name = traceback.tb_frame.f_code.co_filename.rpartition("/")[2]
    return f" ({name}:{traceback.tb_lineno})"


def _modules(traceback: TracebackType | None) -> list[str]:
    """Return the names of the modules in a traceback, the outermost first."""
    modules = []
    while traceback is not None:
        modules.append(str(traceback.tb_frame.f_globals.get("__name__", "")))
        traceback = traceback.tb_next
    return modules


def _is_standard(module: str) -> bool:
    return module.partition(".")[0] in sys.stdlib_module_names


def _is_backend(module: str) -> bool:
    """Return whether a module is a backend of levid or another package, or a library of one."""
    package = module.partition(".")[0]
    return module.startswith(_DRIVERS) or bool(package and package not in _NO_DEVICE)
