"""Loopback backend: the simulated rig plays all three roles, in the process of the loop."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ..config.base import ConfigError, load_yaml
from ..config.shipped import find_file
from ..config.sim import SimConfig
from .base import Array, Backend, CoilAmplifiers, Context, ManipulatorDrives, PositionSensors

if TYPE_CHECKING:
    from ..sim.plant import Plant


class LoopbackBackend(Backend):
    """One simulated plant behind amplifiers, sensors and drives.

    A command written in cycle k acts over [t(k+1), t(k+2)), as on every backend. If periods are
    skipped before t(k+1), the previous command continues to act.
    """

    @classmethod
    def check(cls, context: Context, role: str, options: dict[str, Any]) -> None:
        """Check that there are no options and that SIM.yaml fits the rig; raises ConfigError."""
        if options:
            raise ConfigError(
                f"{role}: backend loopback takes no options, found {', '.join(sorted(options))}"
            )
        _sim_config(context)

    @classmethod
    def emulated(cls, context: Context, role: str, options: dict[str, Any]) -> bool:  # noqa: ARG003
        """Return True: the plant is simulated."""
        return True

    @classmethod
    def gap_step_m(cls, context: Context, options: dict[str, Any]) -> float | None:  # noqa: ARG003
        """Return the step of the simulated converter in m."""
        sensors = _sim_config(context)[1].sensors
        return float(2.0 * sensors.range_m / 2**sensors.bits)

    def __init__(self, context: Context, roles: dict[str, dict[str, Any]]) -> None:  # noqa: ARG002
        """Build the plant, at rest on its stops."""
        from ..sim.plant import Plant  # compiles: a check of a rig must not wait for it

        path, config = _sim_config(context)
        self._sim, self._plant = config, Plant(config, context.period_s, source=path)
        self._cycle: int | None = None
        # A command is pending until the next cycle, then it acts for a period.
        self._pending = _Command(len(context.rig.geometry.coil_x_m), self._plant)
        self._acting = _Command(len(context.rig.geometry.coil_x_m), self._plant)

    def sync(self, cycle: int, late_s: float = 0.0) -> None:  # noqa: ARG002
        """Advance the plant to this cycle and sample it."""
        plant, acting = self._plant, self._acting
        if self._cycle is None:
            self._cycle = cycle
        while self._cycle < cycle:
            plant.advance(acting.coil_n, acting.beam, acting.rotor)
            self._cycle += 1
        acting.all[:] = self._pending.all
        plant.sample()

    def amplifiers(self) -> CoilAmplifiers:
        """Return the simulated coil amplifiers."""
        return _Amplifiers(self._plant, self._pending)

    def sensors(self) -> PositionSensors:
        """Return the simulated position sensors."""
        return _Sensors(self._plant)

    def drives(self) -> ManipulatorDrives:
        """Return the simulated drives."""
        return _Drives(self._plant, self._pending)

    def lift(self, hold: str) -> None:
        """Let a simulated hand hold the platform from now on: see simulated_hand."""
        from ..sim.simulated_hand import hand

        self._plant.push(hand(self._sim, hold))

    def close(self) -> None:
        """Command zero force."""
        self._pending.coil_n[:] = 0.0


class _Command:
    """Forces and setpoints of a cycle in one array; initially zero force and rest."""

    def __init__(self, coils: int, plant: Plant) -> None:
        self.all = np.zeros(coils + 6)
        self.coil_n, self.beam, self.rotor = np.split(self.all, np.cumsum([coils, 3]))
        self.beam[0], self.rotor[0] = plant.beam[0], plant.rotor[0]


class _Amplifiers(CoilAmplifiers):
    def __init__(self, plant: Plant, pending: _Command) -> None:
        self._readback, self._pending = plant.coil_readback_n, pending.coil_n

    def write(self, coil_n: Array) -> None:
        self._pending[:] = coil_n

    def read(self, coil_n: Array) -> None:
        coil_n[:] = self._readback


class _Sensors(PositionSensors):
    def __init__(self, plant: Plant) -> None:
        self._gap = plant.gap_m

    def read(self, gap_m: Array) -> None:
        gap_m[:] = self._gap


class _Drives(ManipulatorDrives):
    def __init__(self, plant: Plant, pending: _Command) -> None:
        self._beam, self._rotor = plant.beam, plant.rotor
        self._pending_beam, self._pending_rotor = pending.beam, pending.rotor

    def write(self, beam: Array, rotor: Array) -> None:
        self._pending_beam[:] = beam
        self._pending_rotor[:] = rotor

    def read(self, beam: Array, rotor: Array) -> None:
        beam[:] = self._beam
        rotor[:] = self._rotor


def _sim_config(context: Context) -> tuple[Path, SimConfig]:
    if context.rig.sim is None:
        raise ConfigError("sim: backend loopback needs the path of a SIM.yaml; add `sim: PATH`")
    path = find_file(context.rig.sim, "sim", folder=context.folder)
    config = load_yaml(path, SimConfig)
    simulated = config.geometry
    coils, sensors = len(context.rig.geometry.coil_x_m), len(context.rig.geometry.sensors_x_m)
    if (coils, sensors) != (simulated.n_coils, simulated.n_sensors):
        raise ConfigError(
            f"{path}: expected the rig's {coils} coils and {sensors} sensors, "
            f"found {simulated.n_coils} and {simulated.n_sensors}"
        )
    return path, config
