"""Emulate amplifiers, ADC and drives on any bus: sampling, expiry, limits, trips, the plant.

The host paces the plant: each cycle advances it. Without a host the plant runs on the clock of this
machine, so that setpoints expire and the platform drops when the bus is lost.
"""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...config.rig import RigConfig
from ...config.sim import SimConfig
from ...wire.can.cia402 import ENCODER_LOST
from ...wire.device_protocol import (
    AMPLIFIER_LIMITS,
    CYCLES,
    AmplifierState,
    DeviceParameter,
    DriveState,
    Refusal,
    Request,
    SensorState,
    expected_parameters,
    response,
)
from ..plant import Plant
from ..simulated_hand import hand
from .faulty_actuators import FaultyActuators

Array = NDArray[np.float64]

_SILENT_PERIODS = 1.5
"""Periods after a SYNC until the next one is missing."""
_BEHIND = 16
"""Most cycles by which one bus may lag another."""
_NEW_COUNT = 1000
"""A larger jump of the cycle number comes from a new host, not from a late one."""
_TOLERANCE_N = 1e-3
"""Rounding of setpoints, by which they may exceed a limit."""


@dataclass
class Injected:
    """Injected faults of the devices; see faults."""

    stuck: set[int] = field(default_factory=set)
    frozen: set[int] = field(default_factory=set)
    off_m: dict[int, float] = field(default_factory=dict)
    saturated: set[int] = field(default_factory=set)
    lost_axes: set[int] = field(default_factory=set)
    skew_m: float = 0.0
    push_n: float = 0.0
    hold: str = "rest"
    tripping: set[int] = field(default_factory=set)
    actuators: FaultyActuators = field(default_factory=FaultyActuators)


class Core:
    """Amplifiers, ADC and drives of `rig`; public methods may be called from any thread.

    After `begin`: `force_n` (C,) in N, nan for a tripped amplifier; `gap_m` (S,) in m, nan for a
    channel without a reading; `axes` (3, 3): position, velocity, force of X1, X2, PHI in SI units;
    `forced_periods`: number of periods with any coil force since the start.
    """

    def __init__(
        self, rig: RigConfig, sim: SimConfig, source: Path | None, expire_cycles: int
    ) -> None:
        geometry = rig.geometry
        self.coils, self.sensors = len(geometry.coil_x_m), len(geometry.sensors_x_m)
        self.period_s = 1.0 / rig.rate_hz
        self.limits = expected_parameters(rig, expire_cycles)
        self.lock = threading.RLock()
        self.injected = Injected()
        self._sim, self._plant = sim, Plant(sim, self.period_s, source=source)
        self._range_m = sim.sensors.range_m
        limits = rig.device_limits
        self._limit_n, self._step_n = limits.coil_n, limits.coil_rate_n_s * self.period_s
        self._expire = expire_cycles
        self._rng = np.random.default_rng(sim.seed)

        self.amplifier_state = AmplifierState.OFF
        self.sensor_state = SensorState.OK
        self.drive_state = DriveState.OFF
        self.drive_error = 0
        self.forced_periods = 0
        self.force_n = np.zeros(self.coils)
        self.gap_m = np.zeros(self.sensors)
        self.axes = np.zeros((3, 3))
        self._held_m = np.zeros(self.sensors)

        self._cycle: int | None = None
        self._ahead = 0
        self._last_s = time.monotonic()
        self._tripped = 0
        self._challenge = 0
        self._pending_n, self._acting_n = np.zeros(self.coils), np.zeros(self.coils)
        self._fresh = False
        self._missed = 0  # periods since setpoints were applied
        # Beam and rotor: position, velocity, acceleration of this period; _plan has the next ones.
        self._motion = np.zeros((2, 3))
        self._motion[:, 0] = self._plant.beam[0], self._plant.rotor[0]
        self.injected.actuators.motion(self._motion, self.period_s)  # they begin there
        self._plan: list[Array] = []
        self._drives_missed = 0
        self._drives_had_setpoints = False  # a setpoint arrived since they were enabled
        self._sample()

    @property
    def plant(self) -> Plant:
        """The simulated plant, for tests."""
        return self._plant

    @property
    def cycle(self) -> int:
        """The current cycle, modulo CYCLES."""
        return self._cycle or 0

    @property
    def reported_state(self) -> AmplifierState:
        """State that the amplifiers report: UNHEARD if setpoints are missing."""
        if self.amplifier_state is AmplifierState.ENABLED and self._missed:
            return AmplifierState.UNHEARD
        return self.amplifier_state

    @property
    def motion(self) -> Array:
        """Setpoints of beam and rotor (2, 3) in this period: position, velocity, acceleration."""
        return self._motion

    @property
    def drives_silent_s(self) -> float:
        """Time without setpoints for beam and rotor, in s of the plant's time."""
        return self._drives_missed * self.period_s

    @property
    def acting_n(self) -> Array:
        """Forces (C,) in N of the amplifiers in this period."""
        return self._acting_n

    @property
    def driven_n(self) -> Array:
        """Forces (C,) in N that the amplifiers drive, with injected faults."""
        return self.injected.actuators.forces(self._acting_n)

    @property
    def pending_n(self) -> Array:
        """Forces (C,) in N that were received last and act from the next cycle on."""
        return self._pending_n

    def begin(self, cycle: int, modulus: int = CYCLES) -> bool:
        """Begin a cycle: advance the plant and sample the readings.

        `cycle` is counted modulo `modulus`, a divisor of CYCLES. The current cycle again, from
        another bus, changes nothing. Returns whether the cycle is new.
        """
        with self.lock:
            if self._cycle is None:
                self._last_s = time.monotonic()
                self._cycle = cycle
                self._sample()
                return True
            periods = (cycle - self._cycle) % modulus
            if not periods:
                return False
            if modulus - periods <= _BEHIND:
                return False  # another bus is ahead: that cycle is over
            # Only for a new cycle: a host that repeats a cycle is stuck.
            self._last_s = time.monotonic()
            if periods > min(_NEW_COUNT, modulus // 2):
                periods, self._ahead = 1, 0
                self._cycle = cycle if modulus == CYCLES else self._cycle + 1
            else:
                self._cycle = (self._cycle + periods) % CYCLES
            # Periods that passed without a host are not simulated twice. In flight, the rest of
            # them is kept, so that the plant does not stay ahead. At zero force it is discarded:
            # a host may start to count at any time.
            simulated = min(periods, self._ahead)
            enabled = self.amplifier_state is AmplifierState.ENABLED
            self._ahead = self._ahead - simulated if enabled else 0
            for _ in range(periods - simulated):
                self.pass_period()
            self._sample()
            return True

    def apply_setpoints(self, renews: bool = True) -> None:
        """Apply the last received forces, within the limits; called by the bus of the amplifiers.

        Zero force is always within the rate limit. With `renews` False (the cycle is repeated) the
        forces are applied without extending their expiry.
        """
        with self.lock:
            if self.amplifier_state is AmplifierState.ENABLED and self._fresh:
                if renews:
                    self._missed = 0
                acting, step = self._acting_n, self._step_n + _TOLERANCE_N
                low = np.maximum(acting - step, -self._limit_n)
                high = np.minimum(acting + step, self._limit_n)
                np.clip(self._pending_n, low, high, out=acting)
                if not self._pending_n.any():
                    acting[:] = 0.0
            self._fresh = False
            self._expire_setpoints()

    def tick(self, now: float) -> None:
        """Advance the plant if the host is silent; to be called about once a period.

        `now` (monotonic): time up to which all received frames have been handled. Frames that wait
        while this process is delayed do not count as silence.
        """
        with self.lock:
            silent = math.floor((now - self._last_s) / self.period_s - _SILENT_PERIODS) + 1
            if silent <= 0:
                return
            periods = min(silent, _NEW_COUNT)  # do not catch up after a long sleep
            for _ in range(periods):
                self.pass_period()
            self._ahead += periods
            self._last_s = now if periods < silent else self._last_s + periods * self.period_s
            self._expire_setpoints()

    def pass_period(self) -> None:
        """Simulate one period with the acting forces, zero after their expiry."""
        with self.lock:
            self._expire_setpoints()
            plant, acting = self._plant, self._acting_n
            pushed = hand(self._sim, self.injected.hold)
            pushed[2] += self.injected.push_n
            plant.push(pushed)
            actuators = self.injected.actuators
            driven, moved = actuators.forces(acting), actuators.motion(self._motion, self.period_s)
            plant.advance(driven, moved[0], moved[1])
            self.forced_periods += bool(driven.any())
            self._missed += 1
            self._apply_injected()
            if self.amplifier_state is not AmplifierState.ENABLED:
                acting[:] = 0.0
            if self._plan:
                self._motion[:] = self._plan.pop(0)
                self._drives_missed = 0
            else:
                self._drives_missed += 1
                if self._drives_missed > self._expire:
                    self._hold_drives()

    def setpoints(self, coil_n: Array) -> None:
        """Store forces (C,) in N for the next cycle; ignore them if any is not finite."""
        with self.lock:
            if self.amplifier_state is AmplifierState.ENABLED and np.isfinite(coil_n).all():
                self._pending_n[:] = coil_n
                self._fresh = True

    def drive_setpoints(self, plan: Sequence[Array], begun: bool = False) -> None:
        """Store the motion of beam and rotor in the next periods, one array (2, 3) per period.

        Rows: beam and rotor; columns: position, velocity, acceleration at the end of the period.
        With `begun` the first period has started already. Setpoints that are not finite switch off
        drives that had setpoints before.
        """
        with self.lock:
            if self.drive_state is not DriveState.OPERATING:
                return
            if not all(np.isfinite(motion).all() for motion in plan):
                if self._drives_had_setpoints:
                    self.disable_drives()
                return
            self._drives_had_setpoints = True
            limit_m = self.limits[DeviceParameter.BEAM_LIMIT_UM] * 1e-6 + 1e-6
            self._plan = [motion.copy() for motion in plan]
            for motion in self._plan:
                motion[0, 0] = min(max(motion[0, 0], -limit_m), limit_m)
            if begun:
                self._motion[:] = self._plan.pop(0)
                self._drives_missed = 0

    def request(self, request: int, index: int, value: int) -> tuple[int, int]:
        """Answer a request: the parameter and its value, or a Refusal and the request."""
        with self.lock:
            if request == Request.READ:
                return self._read(index)
            if request == Request.ENABLE:
                return self._enable(value)
            if request == Request.RESET:
                return self._reset()
            if request == Request.ENABLE_DRIVES:
                self.enable_drives()
                return DeviceParameter.DRIVE_ERROR, self.drive_error
            return Refusal.NO_SUCH_PARAMETER, request

    def enable_drives(self) -> None:
        """Enable the drives at their position."""
        with self.lock:
            if self.injected.lost_axes:
                return
            self.drive_error = 0
            self._drives_had_setpoints = False
            if self.drive_state is not DriveState.OPERATING:
                self._hold_drives()
                self.drive_state = DriveState.OPERATING

    def disable_drives(self, error: int = 0) -> None:
        """Stop the drives; with `error`, in fault."""
        with self.lock:
            self._hold_drives()
            self.drive_error = error
            self.drive_state = DriveState.FAULT if error else DriveState.OFF

    def _read(self, index: int) -> tuple[int, int]:
        if index == DeviceParameter.CHALLENGE:
            self._challenge = int(self._rng.integers(1, 2**32))
            return index, self._challenge
        if index == DeviceParameter.TRIPPED_COILS:
            return index, self._tripped
        if index == DeviceParameter.FAULTY_SENSORS:
            return index, sum(1 << i for i in self.injected.stuck)
        if index == DeviceParameter.DRIVE_ERROR:
            return index, self.drive_error
        if index in self.limits:
            return index, self.limits[DeviceParameter(index)] & 0xFFFFFFFF
        return Refusal.NO_SUCH_PARAMETER, index

    def _enable(self, value: int) -> tuple[int, int]:
        # A challenge is valid once.
        challenge, self._challenge = self._challenge, 0
        limits = {p: self.limits[p] for p in AMPLIFIER_LIMITS}
        if not challenge or value != response(challenge, limits):
            return Refusal.WRONG_RESPONSE, value
        if self._tripped:
            return Refusal.STILL_TRIPPED, self._tripped
        if self.amplifier_state is not AmplifierState.ENABLED:
            self.amplifier_state = AmplifierState.ENABLED
            self._missed, self._fresh = 0, False
            self._acting_n[:] = 0.0
        return DeviceParameter.TRIPPED_COILS, 0

    def _reset(self) -> tuple[int, int]:
        self._tripped = sum(1 << i for i in self.injected.tripping)
        if not self._tripped and self.amplifier_state is AmplifierState.TRIPPED:
            self.amplifier_state = AmplifierState.OFF
        return DeviceParameter.TRIPPED_COILS, self._tripped

    def _expire_setpoints(self) -> None:
        """Set zero force if setpoints were missing for too long."""
        if self.amplifier_state is AmplifierState.ENABLED and self._missed >= self._expire:
            self.amplifier_state = AmplifierState.EXPIRED
            self._acting_n[:] = 0.0

    def repair_actuators(self) -> None:
        """End the faults of amplifiers and drives; drives stay where they are."""
        self._motion[:, 0] = self.injected.actuators.where(self._motion)
        self.injected.actuators.clear()

    def _hold_drives(self) -> None:
        self._plan.clear()
        self._motion[:, 0] = self.injected.actuators.where(self._motion)
        self._motion[:, 1:] = 0.0

    def _apply_injected(self) -> None:
        injected = self.injected
        if injected.tripping:
            self._tripped |= sum(1 << i for i in injected.tripping)
            self.amplifier_state = AmplifierState.TRIPPED
        if injected.lost_axes and self.drive_state is DriveState.OPERATING:
            self.disable_drives(ENCODER_LOST)

    def _sample(self) -> None:
        self._apply_injected()
        plant, injected, gap = self._plant, self.injected, self.gap_m
        plant.sample()
        gap[:] = plant.gap_m
        self.force_n[:] = plant.coil_readback_n
        if self._tripped:  # nan tells the host which amplifier tripped
            for i in range(self.coils):
                if self._tripped >> i & 1:
                    self.force_n[i] = math.nan
        for i in injected.saturated:
            gap[i] = math.copysign(self._range_m, gap[i])
        for i, error_m in injected.off_m.items():
            gap[i] += error_m
        for i in injected.frozen:
            gap[i] = self._held_m[i]
        self._held_m[:] = gap
        for i in injected.stuck:
            gap[i] = math.nan
        self.sensor_state = SensorState.FAULTY if injected.stuck else SensorState.OK
        beam, rotor = plant.beam, plant.rotor
        self.axes[:2, :2] = beam[:2]
        self.axes[0, 0] += 0.5 * injected.skew_m
        self.axes[1, 0] -= 0.5 * injected.skew_m
        self.axes[:2, 2] = 0.5 * beam[2]
        self.axes[2] = rotor
