"""Run cycles on the devices of a rig, without control, with forces too small to lift."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable
from dataclasses import dataclass
from types import TracebackType
from typing import Self

import numpy as np
from numpy.typing import NDArray

from ...drivers.base import (
    AmplifierError,
    Array,
    Context,
    Devices,
    DriverError,
    SensorError,
    StaleError,
)
from ...drivers.open_backends import emulated, open_devices
from ..host.real_time_scheduling import apply_realtime
from ..planning import point_to_point

_ATTEMPTS = 10
_ENABLING_S, _FIRST_S, _SETTLE_S = 0.2, 1.0, 0.5
_GENTLE = 0.1
"""Share of their limits at which beam and rotor move."""


@dataclass(frozen=True)
class Readings:
    """Readings of n cycles: gap_m (n, S), coil_n (n, C) as measured, commanded_n (n, C).

    beam (n, 3): position and velocity that are set, and the measured position.
    """

    gap_m: Array
    coil_n: Array
    commanded_n: Array
    beam: Array


class DeviceSession:
    """Open devices as a context manager; every command is limited, and zero at the end.

    most_n: largest force of a coil in N. most_total_n: largest sum of the absolute forces of all
    coils in N. Cycles come in real time, but where all is simulated in this process.
    """

    def __init__(self, context: Context, most_n: float, most_total_n: float) -> None:
        self._context, self._most_n, self._most_total_n = context, most_n, most_total_n
        rig = context.rig
        self._coils = len(rig.geometry.coil_x_m)
        self._sensors = len(rig.geometry.sensors_x_m)
        self._gap_m, self._coil_n = np.zeros(self._sensors), np.zeros(self._coils)
        self._beam, self._rotor = np.zeros(3), np.zeros(3)
        self._measured_beam, self._measured_rotor = np.zeros(3), np.zeros(3)
        self._moving, self._moves = self._beam, list[Array]()
        self._holds = False  # until it is known where beam and rotor are
        self._cycle = 0
        self._begin_s = 0.0
        self.largest_n = 0.0
        """Largest force of a coil that was commanded so far."""
        loopback = {getattr(rig, role).backend for role in ("amplifiers", "sensors", "drives")}
        self._waits = loopback != {"loopback"}
        self.emulated = emulated(context)

    def __enter__(self) -> Self:
        """Open the devices; raises DriverError or ConfigError."""
        if self._waits:
            apply_realtime(self._context.rig.realtime)  # where it may: a late cycle is repeated
        self._devices: Devices = open_devices(self._context)
        self._begin_s = time.monotonic()
        try:
            self._devices.drives.read(self._measured_beam, self._measured_rotor)
            self.run(round(_FIRST_S / self._context.period_s))  # until all devices answer
            self._beam[0], self._rotor[0] = self._measured_beam[0], self._measured_rotor[0]
            self._holds = True
        except BaseException:
            self._devices.close()
            raise
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Command zero force and close the devices."""
        try:
            self._devices.amplifiers.release(np.zeros(self._coils))
        finally:
            self._devices.close()

    @property
    def devices(self) -> Devices:
        """The open devices."""
        return self._devices

    @property
    def beam_m(self) -> float:
        """Position of the beam, as its drives measure it."""
        return float(self._measured_beam[0])

    @property
    def rotor_rad(self) -> float:
        """Angle of the rotor, as its drive measures it."""
        return float(self._measured_rotor[0])

    def move_beam(self, to_m: float) -> Readings:
        """Move the beam gently to a position in m, wait until it is there, and return the readings.

        Raises DriverError if the position is beyond the limits.
        """
        limits = self._context.rig.limits
        if abs(to_m) > limits.beam_m:
            raise DriverError(
                f"beam: expected a position of at most {limits.beam_m:g} m (limits.beam_m), found "
                f"{to_m:g} m"
            )
        velocity, acceleration = limits.beam_velocity_m_s, limits.beam_acceleration_m_s2
        return self._move(self._beam, to_m, velocity, acceleration)

    def move_rotor(self, to_rad: float) -> Readings:
        """Turn the rotor gently to an angle in rad, wait until it is there; see move_beam."""
        limits = self._context.rig.limits
        velocity, acceleration = limits.rotor_velocity_rad_s, limits.rotor_acceleration_rad_s2
        return self._move(self._rotor, to_rad, velocity, acceleration)

    def run(
        self,
        cycles: int,
        force: Callable[[int], Array] | None = None,
        ended: Callable[[Readings], bool] | None = None,
        every: int = 100,
    ) -> Readings:
        """Run cycles and return their readings.

        force: commands (C,) in N of the k-th cycle, zero if it is None. ended: asked every `every`
        cycles with the readings so far, ends the run early. If a cycle came so late that setpoints
        expired or readings were missing, the devices are recovered and the run begins anew.

        Raises:
            DriverError: a device failed, or a command exceeds the limits.
        """
        for _ in range(_ATTEMPTS):
            try:
                return self._run(cycles, force, ended, every)
            except (AmplifierError, StaleError) as error:
                failed = error
                self._devices.recover()
                with contextlib.suppress(AmplifierError, StaleError):
                    # Amplifiers are enabled while no force is commanded.
                    self._run(round(_ENABLING_S / self._context.period_s), None, None, 1)
        raise failed

    def _run(
        self,
        cycles: int,
        force: Callable[[int], Array] | None,
        ended: Callable[[Readings], bool] | None,
        every: int,
    ) -> Readings:
        gap, coil = np.zeros((cycles, self._sensors)), np.zeros((cycles, self._coils))
        commanded, zero = np.zeros((cycles, self._coils)), np.zeros(self._coils)
        beam = np.zeros((cycles, 3))
        devices = self._devices
        for k in range(cycles):
            self._wait()
            devices.sync(self._cycle)
            # What a driver finds wrong with a reading shows in the reading, judged later.
            with contextlib.suppress(SensorError):
                devices.sensors.read(self._gap_m)  # a missing reading leaves the last one
            devices.amplifiers.read(self._coil_n)
            devices.drives.read(self._measured_beam, self._measured_rotor)
            gap[k], coil[k] = self._gap_m, self._coil_n
            command = zero if force is None else self._checked(force(k))
            commanded[k] = command
            devices.amplifiers.write(command)
            if self._moves:
                self._moving[:] = self._moves.pop(0)
            beam[k] = self._beam[0], self._beam[1], self._measured_beam[0]
            if self._holds:
                devices.drives.write(self._beam, self._rotor)
            if ended is not None and (k + 1) % every == 0:
                so_far = Readings(gap[: k + 1], coil[: k + 1], commanded[: k + 1], beam[: k + 1])
                if ended(so_far):
                    return so_far
        devices.amplifiers.write(zero)
        return Readings(gap, coil, commanded, beam)

    def _move(self, axis: Array, to: float, velocity: float, acceleration: float) -> Readings:
        """Move the setpoint (3,) of an axis at a share of its limits, and let it settle."""
        period_s = self._context.period_s
        slow, soft = _GENTLE * velocity, _GENTLE * acceleration
        self._moving = axis
        self._moves = list(point_to_point.move(float(axis[0]), to, slow, soft, period_s))
        return self.run(len(self._moves) + round(_SETTLE_S / period_s))

    def _checked(self, force_n: NDArray[np.float64]) -> Array:
        size = np.abs(force_n)
        if not (size.max() <= self._most_n and size.sum() <= self._most_total_n):
            raise DriverError(
                f"commissioning: expected at most {self._most_n:g} N a coil and "
                f"{self._most_total_n:g} N in all, found {size.max():g} N and {size.sum():g} N"
            )
        self.largest_n = max(self.largest_n, float(size.max()))
        return force_n

    def _wait(self) -> None:
        """Wait for the next period; periods that were missed are skipped."""
        period_s = self._context.period_s
        self._cycle += 1
        if not self._waits:
            return
        due_s = self._begin_s + self._cycle * period_s
        late_s = time.monotonic() - due_s
        if late_s < 0.0:
            time.sleep(-late_s)
        elif late_s > period_s:
            self._cycle += int(late_s / period_s)
