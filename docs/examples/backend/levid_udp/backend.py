"""The UDP backend: amplifiers, position sensors and drives on one link."""

from __future__ import annotations

from typing import Any

import numpy as np

from levid.config.backends import ROLES
from levid.config.base import ConfigError
from levid.config.buses import AmplifierOptions, SerialDriveOptions
from levid.config.rig import RigConfig
from levid.drivers.amplifier_enabling import AmplifierWatch, compare_limits, refusal
from levid.drivers.base import (
    Array,
    CoilAmplifiers,
    Context,
    DriveError,
    ManipulatorDrives,
    PositionSensors,
)
from levid.drivers.bus_backend import AnswerTime, BusBackend
from levid.drivers.reading_checks import SensorWatch, check_skew
from levid.log.signals import Stale
from levid.wire.device_protocol import (
    AMPLIFIER_LIMITS,
    DRIVE_LIMITS,
    SENSOR_LIMITS,
    AmplifierState,
    DriveState,
    Request,
    expected_parameters,
)

from .link import UdpLink

_RANGE_M = 1e-3


class UdpBackend(BusBackend):
    """Plays all three roles on one bus."""

    @classmethod
    def check(cls, context: Context, role: str, options: dict[str, Any]) -> None:  # noqa: ARG003
        """Check that all roles are on the same bus; raises ConfigError."""
        on = [context.rig.on_bus(each) for each in ROLES]
        found = {(each[0], each[1].bus) for each in on if each is not None}
        if None in on or len(found) != 1:
            raise ConfigError(
                f"{role}: expected amplifiers, sensors and drives on the same bus of 'udp'"
            )

    def __init__(self, context: Context, roles: dict[str, dict[str, Any]]) -> None:  # noqa: ARG002
        """Open the link, compare the device's limits, enable the drives; raises DriverError."""
        rig = context.rig
        options = {role: found[1] for role in ROLES if (found := rig.on_bus(role))}
        amplifiers, drives = options["amplifiers"], options["drives"]
        assert isinstance(amplifiers, AmplifierOptions)
        assert isinstance(drives, SerialDriveOptions)
        self._link = UdpLink(amplifiers.bus, rig, AnswerTime.of(context))
        self._amplifiers = _Amplifiers(self._link, rig, amplifiers.expire_cycles)
        self._sensors = _Sensors(self._link, rig)
        self._drives = _Drives(self._link, rig, drives.skew_m)
        self._roles = dict(zip(ROLES, (self._amplifiers, self._sensors, self._drives), strict=True))
        try:
            self.recover()
        except BaseException:
            self.close()
            raise

    def sync(self, cycle: int, late_s: float = 0.0) -> None:
        """Begin a cycle: setpoints out, samples in."""
        self._mark_stale()
        self._link.sync(cycle, late_s)

    def recover(self) -> None:
        """Open the link again, compare limits, reset trips, enable the drives."""
        self._link.open()
        for role in (self._amplifiers, self._sensors, self._drives):
            role.recover()

    @property
    def stale(self) -> int:
        """Cycles without a reading in time."""
        return self._link.watch.stale

    def close(self) -> None:
        """Send zero force and close the link; amplifiers switch off after expire_cycles."""
        self._amplifiers.release(np.zeros_like(self._link.coil_n))
        self._link.close()


class _Amplifiers(CoilAmplifiers):
    def __init__(self, link: UdpLink, rig: RigConfig, expire_cycles: int) -> None:
        self._link, self._limits = link, expected_parameters(rig, expire_cycles)
        self._watch = AmplifierWatch(
            f"amplifiers on {link.what}", self._limits, link.ask, link.stale_cycles
        )
        link.amplifiers = self._watch

    def write(self, coil_n: Array) -> None:
        self._watch.commanding(coil_n)
        self._link.coil_n[:] = coil_n

    def release(self, zero_n: Array) -> None:
        self.write(zero_n)
        self._link.send_setpoints()

    def read(self, coil_n: Array) -> None:
        self._link.collect()
        if self._link.fresh:
            readings = self._link.readings
            coil_n[:] = readings["coil_n"]
            state = int(readings["amplifier_state"])
            self.stale = int(Stale.SETPOINTS) if state == AmplifierState.UNHEARD else 0
            self._watch.judge(state, coil_n)

    def recover(self) -> None:
        self._link.coil_n[:] = 0.0
        compare_limits(self._link.what, self._limits, AMPLIFIER_LIMITS, self._link.exchange)
        self._watch.reset(self._link.exchange)


class _Sensors(PositionSensors):
    def __init__(self, link: UdpLink, rig: RigConfig) -> None:
        self._link, self._limits = link, expected_parameters(rig, 0)
        self._watch = SensorWatch(f"sensors on {link.what}", rig.geometry, _RANGE_M)

    def read(self, gap_m: Array) -> None:
        self._link.collect()
        if self._link.fresh:  # else the last reading stays
            gap_m[:] = self._link.readings["gap_m"]
            self.stale = 0
            self._watch.judge(gap_m, int(self._link.readings["sensor_state"]))

    def recover(self) -> None:
        compare_limits(self._link.what, self._limits, SENSOR_LIMITS, self._link.exchange)
        self._watch.reset()


class _Drives(ManipulatorDrives):
    def __init__(self, link: UdpLink, rig: RigConfig, skew_m: float) -> None:
        self._link, self._limits, self._skew_m = link, expected_parameters(rig, 0), skew_m
        self._axes = np.full((3, 3), np.nan)
        self._released = False

    def write(self, beam: Array, rotor: Array) -> None:
        self._link.beam[:], self._link.rotor[:] = beam, rotor
        if self._released:
            self.release()

    def release(self) -> None:
        # nan setpoints: the drives brake and switch off.
        self._released = True
        self._link.beam[:] = self._link.rotor[:] = np.nan

    def read(self, beam: Array, rotor: Array) -> None:
        link, axes = self._link, self._axes
        link.collect()
        if link.fresh:
            axes[:] = link.readings["axes"]
            self.stale = 0
        beam[:] = 0.5 * (axes[0] + axes[1])
        beam[2] = axes[0, 2] + axes[1, 2]
        rotor[:] = axes[2]
        if link.fresh and not self._released:
            self._check(int(link.readings["drive_state"]), int(link.readings["drive_error"]))

    def recover(self) -> None:
        link = self._link
        self.release()  # they may have been moved by hand: earlier setpoints are no targets
        compare_limits(link.what, self._limits, DRIVE_LIMITS, link.exchange)
        index, error = link.exchange(Request.ENABLE_DRIVES, 0, 0)
        if (why := refusal(index)) or error:
            raise DriveError(f"drives on {link.what}: not enabled{why}, error code 0x{error:04X}")
        self._released = False

    def _check(self, state: int, error: int) -> None:
        what = f"drives on {self._link.what}"
        try:
            if state != DriveState.OPERATING:
                raise DriveError(f"{what}: not operating, error code 0x{error:04X}")
            check_skew(what, self._axes[0, 0], self._axes[1, 0], self._skew_m)
        except DriveError:
            self.release()  # two motors askew must not stay powered against each other
            raise
