"""Emulate all electronics of a rig: one simulated plant, and an emulator on every bus."""

from __future__ import annotations

from pathlib import Path
from typing import Protocol

from ...config.backends import ROLES, find_backend, load_part
from ...config.base import ConfigError, load_yaml
from ...config.buses import AmplifierOptions, RoleOptions
from ...config.rig import RigConfig
from ...config.shipped import find_file
from ...config.sim import SimConfig
from .emulated_devices import Core
from .faults import Injector


class Emulator(Protocol):
    """Electronics at the far end of one bus."""

    def start(self) -> None:
        """Open the bus and answer from now on."""

    def stop(self) -> None:
        """Stop answering and close the bus."""


class Electronics:
    """A context manager that emulates the electronics.

    `core`, `injector` and `emulators`, one for each bus, are for tests.

    Raises:
        ConfigError: a role is on no bus, its backend has no emulator, or there is no SIM.yaml.
    """

    def __init__(self, rig: RigConfig, folder: Path) -> None:
        if rig.sim is None:
            raise ConfigError(
                "sim: expected the path of the SIM.yaml that `levid electronics` simulates"
            )
        source = find_file(rig.sim, "sim", folder=folder)
        on: dict[tuple[str, str], dict[str, RoleOptions]] = {}
        expire_cycles = 1
        for role in ROLES:
            backend, options = _on_bus(rig, role)
            on.setdefault((backend, options.bus), {})[role] = options
            if isinstance(options, AmplifierOptions):
                expire_cycles = options.expire_cycles
        self.core = Core(rig, load_yaml(source, SimConfig), source, expire_cycles)
        self.injector = Injector(self.core)
        self.emulators: list[Emulator] = [
            load_part(_emulator(backend), backend)(
                name, rig, folder, roles, self.core, self.injector
            )
            for (backend, name), roles in on.items()
        ]

    def __enter__(self) -> Electronics:
        """Start every emulator."""
        for bus in self.emulators:
            bus.start()
        return self

    def __exit__(self, *_: object) -> None:
        """Stop every emulator."""
        for bus in self.emulators:
            bus.stop()

    def status(self) -> dict[str, object]:
        """Return the states of amplifiers, ADC and drives, the forces in N, and injected faults."""
        core = self.core
        with core.lock:
            return {
                "amplifiers": core.amplifier_state.name,
                "sensors": core.sensor_state.name,
                "drives": core.drive_state.name,
                "acting_n": core.acting_n.tolist(),
                "driven_n": core.driven_n.tolist(),
                "forced_periods": core.forced_periods,
                "wire": sorted(self.injector.wire),
            }


def _on_bus(rig: RigConfig, role: str) -> tuple[str, RoleOptions]:
    """Return backend and options of a role; raises ConfigError if it cannot be emulated."""
    found = rig.on_bus(role)
    if found is None or not _emulator(found[0]):
        raise ConfigError(
            f"{role}.backend: expected a backend with emulated electronics, such as can or "
            f"serial, found {getattr(rig, role).backend}"
        )
    return found


def _emulator(backend: str) -> str:
    descriptor = find_backend(backend)
    return (descriptor.emulator if descriptor is not None else None) or ""
