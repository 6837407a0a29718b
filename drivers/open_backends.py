"""Check and open the backends that a rig's roles name."""

from __future__ import annotations

from typing import Any

from ..config.backends import ENTRY_POINT_GROUP, ROLES, find_backend, load_part, names
from ..config.base import ConfigError
from ..wire.bus_budget import Budget, check_budget
from .base import Backend, Context, Devices
from .channel_scales import scaled_amplifiers, scaled_sensors

__all__ = [
    "ENTRY_POINT_GROUP",
    "ROLES",
    "check_backends",
    "emulated",
    "gap_step_m",
    "missing",
    "names",
    "open_devices",
    "reads_back",
]


def check_backends(context: Context) -> Budget:
    """Check the backend and options of every role, and whether the buses carry the rate.

    No device is opened. Returns the bus budget; raises ConfigError.
    """
    for role, (name, options) in _roles(context).items():
        _backend_class(name, role).check(context, role, options)
    return check_budget(context.rig, context.folder)


def emulated(context: Context) -> bool:
    """Return whether all devices of the rig are simulated; no device is opened."""
    return all(
        _backend_class(name, role).emulated(context, role, options)
        for role, (name, options) in _roles(context).items()
    )


def reads_back(context: Context) -> bool:
    """Return whether the rig's amplifiers measure the coil forces; no device is opened."""
    name, options = _roles(context)["amplifiers"]
    return _backend_class(name, "amplifiers").reads_back(context, options)


def gap_step_m(context: Context) -> float | None:
    """Return the step of the sensors' readings in m, None if unknown; no device is opened."""
    name, options = _roles(context)["sensors"]
    return _backend_class(name, "sensors").gap_step_m(context, options)


def missing(context: Context) -> list[str]:
    """Return what of the machine the roles lack, such as a network that is down."""
    found = (
        _backend_class(name, role).missing(context, role, options)
        for role, (name, options) in _roles(context).items()
    )
    return list(dict.fromkeys(filter(None, found)))


def open_devices(context: Context) -> Devices:
    """Open each backend once for all of its roles; raises ConfigError or DriverError."""
    check_backends(context)
    roles_of: dict[str, dict[str, dict[str, Any]]] = {}
    for role, (name, options) in _roles(context).items():
        roles_of.setdefault(name, {})[role] = options
    opened: dict[str, Backend] = {}
    try:
        for name, roles in roles_of.items():
            opened[name] = _backend_class(name, next(iter(roles)))(context, roles)
        rig = context.rig
        return Devices(
            scaled_amplifiers(opened[rig.amplifiers.backend].amplifiers(), rig.channels),
            scaled_sensors(opened[rig.sensors.backend].sensors(), rig.channels),
            opened[rig.drives.backend].drives(),
            tuple(opened.values()),
            reads_back(context),
        )
    except BaseException:
        for backend in opened.values():
            backend.close()
        raise


def _roles(context: Context) -> dict[str, tuple[str, dict[str, Any]]]:
    """Return the backend's name and the options of each role."""
    return {
        role: (getattr(context.rig, role).backend, getattr(context.rig, role).options)
        for role in ROLES
    }


def _backend_class(name: str, role: str) -> type[Backend]:
    descriptor = find_backend(name)
    if descriptor is None:
        raise ConfigError(f"{role}.backend: expected one of {', '.join(names())}, found '{name}'")
    found = load_part(descriptor.backend, name)
    if not (isinstance(found, type) and issubclass(found, Backend)):
        raise ConfigError(
            f"{role}.backend: expected {descriptor.backend} to be a subclass of "
            f"levid.drivers.base.Backend; correct the package that registers '{name}'"
        )
    return found
