"""CAN backend: amplifiers, ADC and drives on any number of buses."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import suppress
from time import perf_counter
from typing import Any

import numpy as np

from ...config.backends import ROLES
from ...config.base import ConfigError
from ...config.buses import AmplifierOptions, CanBus, CanDriveOptions, RoleOptions
from ...config.rig import RigConfig
from ...wire.can import cia402
from ...wire.can.can_frames import CanFrames, load_frames
from ...wire.can.cia402 import NMT_ID, NODE_IDS, SYNC_ID
from ...wire.can.python_can_interface_table import check_bus
from ...wire.device_protocol import AMPLIFIER_LIMITS, CYCLES, SENSOR_LIMITS, check_limits_fit
from ...wire.int16_scaling import LARGEST
from ..base import Context, FirstError, LinkError
from ..bus_backend import AnswerTime, BusBackend
from ..channel_scales import check_command_range
from ..remedies import has_no_hardware, network_problem
from .amplifiers_and_adc import CanAmplifiers, CanSensors
from .bus_link import CanLink
from .canopen_drives import CanDrives
from .canopen_homing_and_enabling import node_of


class CanBackend(BusBackend):
    """Opens each bus once for all roles on it."""

    @classmethod
    def check(cls, context: Context, role: str, options: dict[str, Any]) -> None:  # noqa: ARG003
        """Check a role's options, its bus and the DBC; raises ConfigError."""
        bus = _bus_of(context.rig, role)
        check_bus(f"can.{_option(context.rig, role).bus}", bus)
        _check_ids(context, role)
        if role == "drives":
            cia402.check_limits_fit(context.rig.limits)
            _check_expiry(context.rig)
            _check_eds(context)
            return
        check_limits_fit(context.rig, AMPLIFIER_LIMITS if role == "amplifiers" else SENSOR_LIMITS)
        frames = _frames(context, bus)
        largest_n = frames.setpoint.unit * LARGEST
        if role == "amplifiers":
            check_command_range(context.rig, largest_n, "the DBC's setpoints")

    @classmethod
    def emulated(cls, context: Context, role: str, options: dict[str, Any]) -> bool:  # noqa: ARG003
        """Return whether the bus has no hardware: between programs, or the kernel's own."""
        return has_no_hardware(_bus_of(context.rig, role))

    @classmethod
    def gap_step_m(cls, context: Context, options: dict[str, Any]) -> float | None:  # noqa: ARG003
        """Return the step of the DBC's readings in m."""
        return _frames(context, _bus_of(context.rig, "sensors")).gap.unit

    @classmethod
    def missing(cls, context: Context, role: str, options: dict[str, Any]) -> str:  # noqa: ARG003
        """Return why the bus's network interface cannot be used, and what to do."""
        return network_problem(_bus_of(context.rig, role))

    def __init__(self, context: Context, roles: dict[str, dict[str, Any]]) -> None:
        """Open the buses, compare limits with the devices, home and enable the drives."""
        rig = context.rig
        self._answers = AnswerTime.of(context)
        self._deadline_s = 0.0
        self._links: dict[str, CanLink] = {}
        self._syncs: list[tuple[CanLink, CanFrames]] = []
        self._roles = {}
        self._dbc_roles: list[CanAmplifiers | CanSensors] = []
        self._drives: CanDrives | None = None
        self._amplifiers: CanAmplifiers | None = None
        for role in roles:
            option = _option(rig, role)
            bus = rig.can[option.bus]
            link = self._links.setdefault(option.bus, CanLink(option.bus, bus))
            if isinstance(option, CanDriveOptions):
                self._roles[role] = self._drives = CanDrives(
                    link, rig, option, context.folder, bus.stale_cycles, self._deadline
                )
                continue
            frames = next((f for to, f in self._syncs if to is link), None)
            if frames is None:
                frames = _frames(context, bus)
                self._syncs.append((link, frames))
            if isinstance(option, AmplifierOptions):
                self._amplifiers = CanAmplifiers(
                    link, frames, rig, option.expire_cycles, bus.stale_cycles, self._deadline
                )
                self._dbc_roles.append(self._amplifiers)
            else:
                self._dbc_roles.append(
                    CanSensors(link, frames, rig, bus.stale_cycles, self._deadline)
                )
            self._roles[role] = self._dbc_roles[-1]
        self._coils = len(rig.geometry.coil_x_m)
        try:
            self.recover()
        except BaseException:
            self.close()
            raise

    def sync(self, cycle: int, late_s: float = 0.0) -> None:
        """Begin a cycle on every bus, even if one fails; raises the first error.

        Without a Sync the amplifiers on a working bus would keep their force.
        """
        # Before anything else: the answer to a late Sync is sampled late too.
        self._deadline_s = self._answers.deadline_s(perf_counter(), late_s)
        self._mark_stale()
        first = FirstError()
        for link in self._links.values():
            with first:
                link.drain()
        number = cycle % CYCLES
        for role in self._dbc_roles:
            role.readings.begin(number)
        if self._amplifiers is not None:
            self._amplifiers.cycle = number
        for link, frames in self._syncs:
            with first:
                link.send(*frames.sync.encode(number))
        if self._drives is not None:
            with first:
                self._drives.sync(cycle)
        first.raise_it()

    def recover(self) -> None:
        """Reopen all buses, compare limits, reset trips, home drives; raises DriverError."""
        for link in self._links.values():
            link.open()
        for role in self._dbc_roles:
            role.recover()
        if self._drives is not None:
            self._drives.recover()

    @property
    def stale(self) -> int:
        """Number of missing readings, summed over the devices."""
        of_drives = self._drives.watch.stale if self._drives is not None else 0
        return of_drives + sum(role.readings.watch.stale for role in self._dbc_roles)

    def close(self) -> None:
        """Send zero force, stop the drives and close the buses.

        If these frames are lost, the devices switch off when their setpoints expire.
        """
        try:
            if self._amplifiers is not None:
                with suppress(LinkError):
                    self._amplifiers.release(np.zeros(self._coils))
                    self._begin_last_cycle()
            if self._drives is not None:  # also if only some of them were enabled
                with suppress(LinkError):
                    self._drives.leave()
        finally:
            for link in self._links.values():
                link.close()

    def _begin_last_cycle(self) -> None:
        """Send a Sync, at which the last setpoints take effect."""
        assert self._amplifiers is not None
        for link, frames in self._syncs:
            with suppress(LinkError):
                link.send(*frames.sync.encode((self._amplifiers.cycle + 1) % CYCLES))

    def _deadline(self) -> float:
        return self._deadline_s


def _check_ids(context: Context, role: str) -> None:
    """Raise ConfigError if two frames on the bus of `role` have the same ID."""
    rig, name = context.rig, _option(context.rig, role).bus
    roles = [each for each in ROLES if getattr(rig, each).backend == "can"]
    on = {each: found for each in roles if (found := _option(rig, each)).bus == name}
    used: dict[int, str] = {}
    for can_id, what in _ids(context, rig.can[name], on):
        if can_id in used:
            raise ConfigError(
                f"can.{name}: expected a different ID for each frame, found 0x{can_id:03X} "
                f"for {used[can_id]} and {what}"
            )
        used[can_id] = what


def _ids(context: Context, bus: CanBus, on: Mapping[str, RoleOptions]) -> Iterator[tuple[int, str]]:
    """Yield ID and name of every frame of these roles."""
    amplifiers, sensors = "amplifiers" in on, "sensors" in on
    if amplifiers or sensors:
        yield from _frames(context, bus).ids(amplifiers=amplifiers, sensors=sensors)
    drives = on.get("drives")
    if isinstance(drives, CanDriveOptions):
        yield NMT_ID, "NMT"
        yield SYNC_ID, "SYNC"
        for name, number in drives.nodes.model_dump().items():
            for what, can_id in NODE_IDS.items():
                yield can_id + number, f"{what} of {name} (node {number})"


def _check_expiry(rig: RigConfig) -> None:
    """Raise ConfigError if targets would expire between two SYNC of the drives."""
    drives = _option(rig, "drives")
    assert isinstance(drives, CanDriveOptions)
    least_s = 2.0 * drives.every / rig.rate_hz
    if drives.expire_s < least_s:
        raise ConfigError(
            f"drives.expire_s: expected at least {least_s:g}, two periods of the drives' SYNC, "
            f"found {drives.expire_s:g}"
        )


def _check_eds(context: Context) -> None:
    drives = _option(context.rig, "drives")
    assert isinstance(drives, CanDriveOptions)
    if drives.eds is not None:
        node_of(drives.nodes.x1, context.folder / drives.eds)


def _option(rig: RigConfig, role: str) -> RoleOptions:
    """Return the options of a role that is on a bus; raises ConfigError."""
    found = rig.on_bus(role)
    assert found is not None
    return found[1]


def _bus_of(rig: RigConfig, role: str) -> CanBus:
    return rig.can[_option(rig, role).bus]


def _frames(context: Context, bus: CanBus) -> CanFrames:
    geometry = context.rig.geometry
    dbc = context.folder / bus.dbc if bus.dbc else None
    return load_frames(dbc, len(geometry.coil_x_m), len(geometry.sensors_x_m), bus.fd)
