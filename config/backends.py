"""Find backends by name: levid's own, and those that other packages register as entry points."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache
from importlib import import_module
from importlib.metadata import entry_points
from typing import Any

from .base import ConfigError, parse
from .buses import RoleOptions

ENTRY_POINT_GROUP = "levid.backends"
ROLES = ("amplifiers", "sensors", "drives")
"""Roles of a rig; each names its backend."""


@dataclass(frozen=True)
class BackendDescriptor:
    """Names of a backend's parts, each written `module:name`.

    A part is imported when it is first used, so that reading RIG.yaml imports no driver and no
    simulator. A backend without buses has `backend` only.
    """

    backend: str
    """Subclass of levid.drivers.base.Backend."""
    bus: str | None = None
    """Keys of one bus, a subclass of levid.config.buses.Bus. RIG.yaml lists the buses by name in a
    section that has the backend's name."""
    options: Mapping[str, str] = field(default_factory=dict)
    """Keys of each role that the backend plays: subclasses of levid.config.buses.RoleOptions."""
    bus_time: str | None = None
    """Function (rig, bus name, options by role, folder) -> levid.wire.bus_budget.BusTime."""
    alternatives: str | None = None
    """Function (rig, folder) -> lines for the error if the rate is too high for the buses."""
    emulator: str | None = None
    """Class (bus name, rig, folder, options by role, core, injector) with start() and stop()."""


OWN: Mapping[str, BackendDescriptor] = {
    "loopback": BackendDescriptor(backend="levid.drivers.loopback:LoopbackBackend"),
    "can": BackendDescriptor(
        backend="levid.drivers.can.backend:CanBackend",
        bus="levid.config.buses:CanBus",
        options={
            "amplifiers": "levid.config.buses:AmplifierOptions",
            "sensors": "levid.config.buses:SensorOptions",
            "drives": "levid.config.buses:CanDriveOptions",
        },
        bus_time="levid.wire.can.worst_case_cycle_time:bus_time",
        alternatives="levid.wire.can.worst_case_cycle_time:alternatives",
        emulator="levid.sim.electronics.can_emulator:CanElectronics",
    ),
    "serial": BackendDescriptor(
        backend="levid.drivers.serial.backend:SerialBackend",
        bus="levid.config.buses:SerialBus",
        options={
            "amplifiers": "levid.config.buses:AmplifierOptions",
            "sensors": "levid.config.buses:SensorOptions",
            "drives": "levid.config.buses:SerialDriveOptions",
        },
        bus_time="levid.wire.serial.worst_case_cycle_time:bus_time",
        emulator="levid.sim.electronics.serial_emulator:SerialElectronics",
    ),
}


def names() -> list[str]:
    """Return the names of all installed backends."""
    return sorted({*OWN, *_installed(tuple(sys.path))})


def find_backend(name: str) -> BackendDescriptor | None:
    """Return the backend of that name, None if none is installed.

    An entry point may name a BackendDescriptor, or a Backend subclass that has no buses.

    Raises:
        ConfigError: the entry point cannot be loaded.
    """
    if name in OWN:
        return OWN[name]
    part = _installed(tuple(sys.path)).get(name)
    if part is None:
        return None
    found = load_part(part, name)
    return found if isinstance(found, BackendDescriptor) else BackendDescriptor(part)


@cache
def _installed(_: tuple[str, ...]) -> dict[str, str]:
    """Return backends of other packages by name, for one search path.

    Looking for them takes 2 ms, and every key of a rig that levid does not know asks for them.
    """
    return {entry.name: entry.value for entry in entry_points(group=ENTRY_POINT_GROUP)}


def load_part(part: str, backend: str) -> Any:
    """Import `part`, written `module:name`; `backend` is named in the error.

    Raises:
        ConfigError: it cannot be imported.
    """
    module, _, attribute = part.partition(":")
    try:
        return getattr(import_module(module), attribute)
    except Exception as error:  # noqa: BLE001 - a module of another package may raise anything
        raise ConfigError(f"backend '{backend}': cannot load {part}: {error}") from None


def bus_schema(backend: str) -> Any:
    """Return the Bus subclass of a backend; None if it is not installed or has no buses."""
    found = find_backend(backend)
    return None if found is None or found.bus is None else load_part(found.bus, backend)


def role_options(backend: str, role: str, keys: Mapping[str, Any]) -> RoleOptions | None:
    """Parse the keys of a role; None if its backend has no buses or is not installed.

    Raises:
        ConfigError: a key is wrong or missing, or the backend does not play the role.
    """
    found = find_backend(backend)
    if found is None or found.bus is None:
        return None
    if role not in found.options:
        raise ConfigError(
            f"{role}.backend: expected a backend with {role}; '{backend}' has "
            f"{', '.join(found.options)} only"
        )
    schema: type[RoleOptions] = load_part(found.options[role], backend)
    return parse(dict(keys), schema, role)
