"""Serial backend: all roles on serial ports, one transaction per port and cycle."""

from __future__ import annotations

from contextlib import suppress
from typing import Any

import numpy as np

from ...config.buses import AmplifierOptions, SerialDriveOptions
from ...config.rig import RigConfig
from ...log.signals import Stale
from ...wire.device_protocol import (
    AMPLIFIER_LIMITS,
    DRIVE_LIMITS,
    SENSOR_LIMITS,
    AmplifierState,
    DriveState,
    Request,
    check_limits_fit,
    expected_parameters,
)
from ...wire.int16_scaling import LARGEST
from ...wire.serial.serial_frames import FORCE_N, GAP_M, FrameContents
from ..amplifier_enabling import AmplifierWatch, compare_limits, refusal
from ..base import (
    Array,
    CoilAmplifiers,
    Context,
    DriveError,
    FirstError,
    LinkError,
    ManipulatorDrives,
    PositionSensors,
)
from ..bus_backend import AnswerTime, BusBackend
from ..channel_scales import check_command_range
from ..force_quantiser import ForceQuantiser
from ..reading_checks import SensorWatch, check_skew
from ..remedies import is_pseudo_terminal, port_problem
from .transaction import TransactionPort

_MISSING_SETPOINTS = int(Stale.SETPOINTS)


_LIMITS_OF = {
    "amplifiers": AMPLIFIER_LIMITS,
    "sensors": SENSOR_LIMITS,
    "drives": DRIVE_LIMITS,
}


class SerialBackend(BusBackend):
    """Opens each port once for all roles on it."""

    @classmethod
    def check(cls, context: Context, role: str, options: dict[str, Any]) -> None:  # noqa: ARG003
        """Check a role's options, port and limits; raises ConfigError."""
        context.rig.on_bus(role)
        check_limits_fit(context.rig, _LIMITS_OF[role])
        if role == "amplifiers":
            check_command_range(context.rig, FORCE_N * LARGEST, "the serial protocol")

    @classmethod
    def emulated(cls, context: Context, role: str, options: dict[str, Any]) -> bool:  # noqa: ARG003
        """Return whether the port is a pseudo-terminal, at whose other end is a program."""
        return is_pseudo_terminal(_port(context.rig, role))

    @classmethod
    def missing(cls, context: Context, role: str, options: dict[str, Any]) -> str:  # noqa: ARG003
        """Return why the port cannot be used, and what to do."""
        return port_problem(_port(context.rig, role))

    @classmethod
    def gap_step_m(cls, context: Context, options: dict[str, Any]) -> float | None:  # noqa: ARG003
        """Return the step of the protocol in m."""
        return GAP_M

    def __init__(self, context: Context, roles: dict[str, dict[str, Any]]) -> None:
        """Open the ports, compare limits with the devices, enable the drives."""
        rig = context.rig
        options = {role: found[1] for role in roles if (found := rig.on_bus(role)) is not None}
        names = dict.fromkeys(option.bus for option in options.values())
        on = {name: {r for r, o in options.items() if o.bus == name} for name in names}
        answers = AnswerTime.of(context)
        self._ports = {
            name: TransactionPort(name, rig.serial[name], FrameContents.of(rig, on[name]), answers)
            for name in names
        }
        played: dict[str, _Amplifiers | _Sensors | _Drives] = {}
        for role, option in options.items():
            port = self._ports[option.bus]
            if isinstance(option, AmplifierOptions):
                played[role] = _Amplifiers(port, rig, option.expire_cycles)
            elif isinstance(option, SerialDriveOptions):
                played[role] = _Drives(port, rig, option)
            else:
                played[role] = _Sensors(port, rig)
        self._roles, self._recovering = {**played}, tuple(played.values())
        try:
            self.recover()
        except BaseException:
            self.close()
            raise

    def sync(self, cycle: int, late_s: float = 0.0) -> None:
        """Begin a cycle on every port, even if one fails; raises the first error."""
        self._mark_stale()
        first = FirstError()
        for port in self._ports.values():
            with first:
                port.sync(cycle, late_s)
        first.raise_it()

    def recover(self) -> None:
        """Reopen all ports, compare limits, reset trips, enable drives; raises DriverError."""
        for port in self._ports.values():
            port.open()
        for role in self._recovering:
            role.recover()

    @property
    def stale(self) -> int:
        """Number of cycles without a reading in time."""
        return sum(port.watch.stale for port in self._ports.values())

    def close(self) -> None:
        """Send zero force and close the ports; the device switches off after expire_cycles."""
        amplifiers = self._roles.get("amplifiers")
        try:
            if isinstance(amplifiers, _Amplifiers) and amplifiers.open:
                amplifiers.open = False
                with suppress(LinkError):  # port lost: the device switches off by expiry
                    amplifiers.release(np.zeros_like(amplifiers.port.coil_n))
        finally:
            for port in self._ports.values():
                port.close()


def _port(rig: RigConfig, role: str) -> str:
    """Return the port of a role; raises ConfigError."""
    found = rig.on_bus(role)
    assert found is not None
    return rig.serial[found[1].bus].port


class _Amplifiers(CoilAmplifiers):
    def __init__(self, port: TransactionPort, rig: RigConfig, expire_cycles: int) -> None:
        self.port, self.open = port, False
        self._in_steps = ForceQuantiser(FORCE_N, len(rig.geometry.coil_x_m))
        self._limits = expected_parameters(rig, expire_cycles)
        self._watch = AmplifierWatch(
            f"amplifiers on {port.what}", self._limits, port.ask, port.stale_cycles
        )
        port.amplifiers = self._watch

    def write(self, coil_n: Array) -> None:
        self._watch.commanding(coil_n)
        self.port.coil_n[:] = self._in_steps(coil_n)

    def release(self, zero_n: Array) -> None:
        self.write(zero_n)
        self.port.send_setpoints()

    def read(self, coil_n: Array) -> None:
        self.port.collect()
        if self.port.fresh:
            state = self.port.frames.amplifier_readings(coil_n)
            self.stale = _MISSING_SETPOINTS if state == AmplifierState.UNHEARD else 0
            self._watch.judge(state, coil_n)

    def recover(self) -> None:
        port = self.port
        port.coil_n[:] = 0.0
        compare_limits(port.what, self._limits, AMPLIFIER_LIMITS, port.exchange)
        self._watch.reset(port.exchange)
        self.open = True


class _Sensors(PositionSensors):
    def __init__(self, port: TransactionPort, rig: RigConfig) -> None:
        self._port, self._limits = port, expected_parameters(rig, 0)
        self._watch = SensorWatch(f"sensors on {port.what}", rig.geometry, GAP_M * LARGEST)

    def read(self, gap_m: Array) -> None:
        self._port.collect()
        if self._port.fresh:  # else the last reading stays, without nan
            state = self._port.frames.sensor_readings(gap_m)
            self.stale = 0
            self._watch.judge(gap_m, state)

    def recover(self) -> None:
        port = self._port
        compare_limits(port.what, self._limits, SENSOR_LIMITS, port.exchange)
        self._watch.reset()


class _Drives(ManipulatorDrives):
    def __init__(self, port: TransactionPort, rig: RigConfig, options: SerialDriveOptions) -> None:
        self._port, self._limits = port, expected_parameters(rig, 0)
        self._skew_m = options.skew_m
        self._axes = np.full((3, 3), np.nan)  # until the first reading
        self._stopped = False

    def write(self, beam: Array, rotor: Array) -> None:
        # After an error, even one that only the host detects, the drives get no setpoints: they
        # switch off, and two skewed motors do not push against each other.
        if self._stopped:
            self._clear_setpoints()
            return
        self._port.beam[:] = beam
        self._port.rotor[:] = rotor

    def release(self) -> None:
        self._stopped = True
        self._clear_setpoints()

    def read(self, beam: Array, rotor: Array) -> None:
        port, axes = self._port, self._axes
        port.collect()
        state, error = int(DriveState.OFF), 0
        if port.fresh:
            state, error = port.frames.drive_readings(axes)
        beam[:] = 0.5 * (axes[0] + axes[1])
        beam[2] = axes[0, 2] + axes[1, 2]
        rotor[:] = axes[2]
        self.stale = 0 if port.fresh else self.STALE
        if self._stopped or not port.fresh:
            return
        self._stopped = True
        what = f"drives on {port.what}"
        if state != DriveState.OPERATING:
            raise DriveError(f"{what}: not operating, error code 0x{error:04X}")
        check_skew(what, axes[0, 0], axes[1, 0], self._skew_m)
        self._stopped = False

    def recover(self) -> None:
        port = self._port
        # They may have been moved by hand: setpoints from before the fault are no targets.
        self._clear_setpoints()
        self._axes[:] = np.nan
        compare_limits(port.what, self._limits, DRIVE_LIMITS, port.exchange)
        index, error = port.exchange(Request.ENABLE_DRIVES, 0, 0)
        if why := refusal(index):
            raise DriveError(f"drives on {port.what}: cannot be enabled{why}")
        if error:
            raise DriveError(f"drives on {port.what}: cannot be enabled, error code 0x{error:04X}")
        self._stopped = False

    def _clear_setpoints(self) -> None:
        self._port.beam[:] = self._port.rotor[:] = np.nan
