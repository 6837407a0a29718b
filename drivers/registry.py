"""Backends by name: levid's own, and those other packages register as entry points."""

from __future__ import annotations

import warnings
from importlib import import_module
from importlib.metadata import entry_points
from typing import Any

from ..config.base import ConfigError
from ..wire import device_protocol
from ..wire.bus_budget import Budget, check_budget
from .base import Backend, Context, Devices

ENTRY_POINT_GROUP = "levid.backends"
ROLES = device_protocol.ROLES

_OWN = {
    "loopback": ".loopback:LoopbackBackend",
    "can": ".can.backend:CanBackend",
    "serial": ".serial.backend:SerialBackend",
}


def check_backends(context: Context) -> Budget:
    """Check every role's backend and options, and whether the buses carry the rate.

    Touches no device; returns what the buses carry. Raises ConfigError.
    """
    for role, (name, options) in _roles(context).items():
        _backend_class(name, role).check(context, role, options)
    return check_budget(context.rig, context.folder)


def open_devices(context: Context) -> Devices:
    """Open the backend of every role, each backend once; raises ConfigError or DriverError."""
    check_backends(context)
    wanted: dict[str, dict[str, dict[str, Any]]] = {}
    for role, (name, options) in _roles(context).items():
        wanted.setdefault(name, {})[role] = options
    opened: dict[str, Backend] = {}
    try:
        for name, roles in wanted.items():
            opened[name] = _backend_class(name, next(iter(roles)))(context, roles)
        rig = context.rig
        return Devices(
            opened[rig.amplifiers.backend].amplifiers(),
            opened[rig.sensors.backend].sensors(),
            opened[rig.drives.backend].drives(),
            tuple(opened.values()),
        )
    except BaseException:
        for backend in opened.values():
            backend.close()
        raise


def names() -> list[str]:
    """Return the names of all backends that can be used."""
    return sorted({*_OWN, *(entry.name for entry in entry_points(group=ENTRY_POINT_GROUP))})


def _roles(context: Context) -> dict[str, tuple[str, dict[str, Any]]]:
    return {
        role: (getattr(context.rig, role).backend, getattr(context.rig, role).options)
        for role in ROLES
    }


def _backend_class(name: str, role: str) -> type[Backend]:
    if name in _OWN:
        module, _, attribute = _OWN[name].partition(":")
        own: type[Backend] = getattr(import_module(module, __package__), attribute)
        return own
    for entry in entry_points(group=ENTRY_POINT_GROUP):
        if entry.name != name:
            continue
        try:
            loaded = entry.load()
        except Exception as error:  # noqa: BLE001 - it is somebody else's code
            warnings.warn(f"backend '{name}' ({entry.value}) is broken: {error}", stacklevel=2)
            continue
        if isinstance(loaded, type) and issubclass(loaded, Backend):
            return loaded
        warnings.warn(f"backend '{name}' ({entry.value}) is no levid Backend", stacklevel=2)
    raise ConfigError(f"{role}.backend: expected one of {', '.join(names())}, found '{name}'")
