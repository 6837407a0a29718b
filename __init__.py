"""Control, excite, log and identify a magnetically levitated platform."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from .config.runtime import import_guard

if TYPE_CHECKING:
    from .api.flight import fly as fly
    from .api.identification import Identification as Identification
    from .api.model import Model as Model
    from .api.model import Parameter as Parameter
    from .api.plant import Plant as Plant
    from .api.record import Record as Record
    from .api.session import Session as Session
    from .api.session import load as load
    from .api.trace import FoundEffect as FoundEffect
    from .api.trace import Trace as Trace
    from .config.base import ConfigError as ConfigError
    from .config.shipped import shipped as shipped
    from .config.version import __version__ as __version__
    from .daemon.control.faults import FlightFault as FlightFault
    from .identification.records.record import IdentificationError as IdentificationError
    from .log.errors import LogError as LogError

if __name__ == "levid":  # pytest imports this file under the clone's name as well
    import_guard.install()

# Imported on first use, so that `import levid` takes no time.
_PLACES = {
    "__version__": "config.version",
    "fly": "api.flight",
    "load": "api.session",
    "shipped": "config.shipped",
    "Session": "api.session",
    "Record": "api.record",
    "Identification": "api.identification",
    "Model": "api.model",
    "Parameter": "api.model",
    "Plant": "api.plant",
    "Trace": "api.trace",
    "FoundEffect": "api.trace",
    "ConfigError": "config.base",
    "FlightFault": "daemon.control.faults",
    "IdentificationError": "identification.records.record",
    "LogError": "log.errors",
}
__all__ = [  # noqa: RUF022 - in the order of use
    "load", "fly", "shipped",
    "Session", "Record", "Identification", "Model", "Parameter", "Plant", "Trace", "FoundEffect",
    "ConfigError", "FlightFault", "IdentificationError", "LogError",
]  # fmt: skip


def __getattr__(name: str) -> Any:
    if name not in _PLACES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from importlib import import_module

    value = getattr(import_module(f".{_PLACES[name]}", __name__), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted([*__all__, "__version__"])
