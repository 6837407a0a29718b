"""Refuse logs that do not belong together: of several rigs, of a rig and of imported data."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, Protocol

from ...config.base import ConfigError, parse_text
from ...config.rig import Geometry, RigConfig
from ...log.errors import LogError
from ...log.importing.signals_yaml import SignalsFile

_SEPARATELY = "identify and trace the logs of each plant separately"
_ROLES: tuple[Literal["input", "output"], ...] = ("input", "output")


class LogHead(Protocol):
    """What is read of a log before its rows."""

    @property
    def path(self) -> Path:
        """Path of the log."""

    @property
    def attachments(self) -> Mapping[str, bytes]:
        """Attached files by name."""


def require_one_plant(logs: Iterable[LogHead]) -> None:
    """Check that all logs can be of one plant.

    A rig is known by its name and its geometry; gains, limits, backends and the model may change
    between its flights. Imported data have an input and an output in common, and one unit for each
    signal.

    Raises:
        LogError: two logs are of different plants; it names both logs, and both rigs.
    """
    if found := different_plants(logs):
        raise LogError(f"expected logs of one plant, found {found}; {_SEPARATELY}")


def different_plants(logs: Iterable[LogHead]) -> str:
    """Return the first two logs that cannot be of one plant, and why; empty if all can be."""
    first: LogHead | None = None
    compared: set[tuple[bytes | None, ...]] = set()
    """Attachments that were compared before: most logs of a session have the same."""
    for log in logs:
        files = tuple(log.attachments.get(name) for name in ("rig.yaml", "signals.yaml"))
        if files in compared:
            continue
        compared.add(files)
        if first is None:
            first = log
            continue
        one, other = _plant(first), _plant(log)
        if problem := _difference(one, other):
            return f"{one.described} and {other.described}: {problem}"
    return ""


@dataclass(frozen=True)
class _Plant:
    path: Path
    rig: RigConfig | None = None
    signals: SignalsFile | None = None

    @property
    def described(self) -> str:
        if self.rig is not None:
            return f"{self.path} of the rig '{self.rig.name}'"
        if self.signals is not None:
            return f"{self.path} with imported data"
        return f"{self.path} without a rig.yaml"


def _plant(log: LogHead) -> _Plant:
    """Return the plant of a log; raises LogError for an attachment that is not valid."""
    try:
        if (text := log.attachments.get("signals.yaml")) is not None:
            where = f"{log.path}: signals.yaml"
            return _Plant(log.path, signals=parse_text(text, SignalsFile, where))
        if (text := log.attachments.get("rig.yaml")) is not None:
            return _Plant(log.path, parse_text(text, RigConfig, f"{log.path}: rig.yaml"))
    except ConfigError as error:
        raise LogError(str(error)) from None
    return _Plant(log.path)


def _difference(one: _Plant, other: _Plant) -> str:
    """Return what differs between the plants of two logs; empty if they may be the same."""
    if one.rig is not None and other.rig is not None:
        if one.rig.geometry != other.rig.geometry:
            return f"{_summary(one.rig.geometry)} against {_summary(other.rig.geometry)}"
        return "" if one.rig.name == other.rig.name else "rigs of two names"
    if one.signals is not None and other.signals is not None:
        return _difference_of_signals(one.signals, other.signals)
    alike = (one.rig is None) == (other.rig is None) and (
        (one.signals is None) == (other.signals is None)
    )
    return "" if alike else "their signals differ"


def _difference_of_signals(one: SignalsFile, other: SignalsFile) -> str:
    units, others = ({c.name: c.unit for c in file.columns} for file in (one, other))
    for name in units:
        if units[name] != others.get(name, units[name]):
            return f"{name} is in {units[name]} and in {others[name]}"
    for role in _ROLES:
        names, same = ({c.name for c in file.with_role(role)} for file in (one, other))
        if names and same and not names & same:
            found = " and ".join(", ".join(sorted(part)) for part in (names, same))
            return f"no {role} in common, {found}"
    return ""


def _summary(geometry: Geometry) -> str:
    coils, sensors = len(geometry.coil_x_m), len(geometry.sensors_x_m)
    x, y = geometry.coil_x_m[0], geometry.coil_y_m[0]
    return f"{coils} coils and {sensors} sensors, the first coil at ({x:g}, {y:g}) m,"
