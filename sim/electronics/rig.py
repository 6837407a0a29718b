"""All electronics of a rig: one plant, and something that answers on every bus the rig names."""

from __future__ import annotations

from pathlib import Path
from typing import Protocol

from ...config.base import ConfigError, load_yaml
from ...config.buses import AmplifierOptions
from ...config.rig import RigConfig
from ...config.sim import SimConfig
from ...wire.device_protocol import ROLES
from ...wire.serial.serial_frames import FrameContents
from .core import Core
from .faults import Injector
from .serial_port import SerialElectronics


class Answering(Protocol):
    """Electronics at one end of a bus."""

    def start(self) -> None:
        """Answer from now on."""

    def stop(self) -> None:
        """Stop answering."""


class Electronics:
    """A context manager: answers while it is entered. `core` and `injector` are for tests.

    Raises:
        ConfigError: a role of the rig is on no bus that can be played, or there is no SIM.yaml.
    """

    def __init__(self, rig: RigConfig, folder: Path) -> None:
        if rig.sim is None:
            raise ConfigError(
                "sim: emulated electronics need the path of a SIM.yaml, found nothing"
            )
        source = folder / rig.sim
        roles: dict[tuple[str, str], dict[str, object]] = {}
        expire_cycles = 1
        for role in ROLES:
            found = rig.on_bus(role)
            if found is None:
                raise ConfigError(
                    f"{role}.backend: expected can or serial for electronics to answer, "
                    f"found {getattr(rig, role).backend}"
                )
            backend, options = found
            roles.setdefault((backend, options.bus), {})[role] = options
            if isinstance(options, AmplifierOptions):
                expire_cycles = options.expire_cycles
        self.core = Core(rig, load_yaml(source, SimConfig), source, expire_cycles)
        self.injector = Injector(self.core)
        self._buses: list[Answering] = []
        for (backend, name), on in roles.items():
            if backend == "serial":
                contents = FrameContents.of(rig, on)
                self._buses.append(
                    SerialElectronics(name, rig.serial[name], contents, self.core, self.injector)
                )
            else:
                from .can_bus import CanElectronics

                self._buses.append(CanElectronics(name, rig, folder, on, self.core, self.injector))

    def __enter__(self) -> Electronics:
        """Open every bus and answer."""
        for bus in self._buses:
            bus.start()
        return self

    def __exit__(self, *_: object) -> None:
        """Stop answering."""
        for bus in self._buses:
            bus.stop()

    def status(self) -> dict[str, object]:
        """Return what amplifiers, ADC and drives are doing, for people and scripts."""
        core = self.core
        with core.lock:
            return {
                "amplifiers": core.amplifier_state.name,
                "sensors": core.sensor_state.name,
                "drives": core.drive_state.name,
                "acting_n": core.acting_n.tolist(),
                "forced_periods": core.forced_periods,
                "wire": sorted(self.injector.wire),
            }
