"""Fly in virtual time with sensors that err, and say what the loop found and when."""

from __future__ import annotations

import tempfile
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from levid.benchmarks.daemon.sensor_errors import SensorErrors
from levid.config.base import parse_text
from levid.config.rig import RigConfig, load_rig
from levid.config.session import SessionConfig
from levid.config.shipped import shipped
from levid.daemon.control.faults import FlightFault
from levid.daemon.control.states import State
from levid.daemon.loop.clock import VirtualClock
from levid.daemon.loop.virtual_flight import Flight
from levid.daemon.planning.plan import Plan, plan_session
from levid.drivers.base import PositionSensors
from levid.log.signals import Stale
from levid.model.geometry import shape_matrix
from levid.sim.plant import Plant

Array = NDArray[np.float64]

RIG_FILE = shipped("rigs/loopback.yaml")
PHASES = ("idle", "lift-off", "hover", "excitation", "move", "landing")
_SESSION = """
levid: session
name: spoilt
excitations:
  z: {input: z, rms_n: 1.3}
  psi: {input: psi, rms_n_m: 0.1}
steps:
  - levitate: {unload_s: 0.25, ramp_s: 0.5, settle_s: HOVER_S}
  - record: {name: excited, duration_s: 1.5, settle_s: 0, excite: [z, psi]}
  - move: {beam_m: 0.03, velocity_m_s: 0.05, settle_s: 0.3}
  - land: {ramp_s: 0.6}
"""
_SETTLED_CYCLES = 4
"""Cycles after a fault in which the amplifiers' current may still decay."""


@dataclass(frozen=True)
class Found:
    """What ended a flight: fault and its text, both empty if nothing did.

    cycles: from the first spoilt reading to the fault, both counted. gap_m: largest true gap at a
    sensor when the fault was found, at the end of a flight without one. later_n: largest force
    read back after the fault, from the fifth cycle on.
    """

    fault: str
    text: str
    cycles: int
    gap_m: float
    later_n: float


class SpoiltSensors(PositionSensors):
    """The sensors of a simulated rig, with errors from a cycle on; a reading may be missing."""

    def __init__(
        self, inside: PositionSensors, plant: Plant, errors: SensorErrors, shape: Array
    ) -> None:
        self._inside, self._plant, self._errors, self._shape = inside, plant, errors, shape
        self.line, self.begin, self.cycle = "", 0, 0
        self.missing_from = -1
        """Cycle from which the device does not answer for `missing` cycles."""
        self.missing = 0
        self.true_m: list[float] = []
        """Largest true gap at a sensor, of each cycle."""

    def read(self, gap_m: Array) -> None:
        """Fill `gap_m` (S,)."""
        self.cycle += 1
        self.stale = 0
        if self.line and self.cycle == self.begin:
            self._errors.command(self.line)
        self.true_m.append(float(np.abs(self._shape @ self._plant.pose).max()))
        if 0 <= self.cycle - self.missing_from < self.missing:
            self.stale = int(Stale.SENSORS)
            return
        self._inside.read(gap_m)
        self._errors.spoil(gap_m)


def fly(
    line: str,
    phase: str = "hover",
    share: float = 0.5,
    *,
    rig: RigConfig | None = None,
    sim: Path | None = None,
    rate_hz: float = 1000.0,
    hover_s: float = 0.6,
    missing: tuple[float, int] = (0.0, 0),
) -> Found:
    """Fly a session with the error `line` (see sensor_errors) and return how it ends.

    The error begins after a share (0 to 1) of a phase. missing: time in s after that, and number of
    cycles, in which the sensors' device does not answer.
    """
    rig = load_rig(RIG_FILE) if rig is None else rig
    if sim is not None:
        rig = rig.model_copy(update={"sim": str(sim)})
    session = parse_text(_SESSION.replace("HOVER_S", f"{hover_s:g}"), SessionConfig, "spoilt")
    session = session.model_copy(update={"rate_hz": rate_hz})
    x, y = rig.geometry.sensors_x_m, rig.geometry.sensors_y_m
    with (
        tempfile.TemporaryDirectory() as folder,
        Flight(rig, RIG_FILE.parent, rate_hz, VirtualClock()) as flight,
    ):
        plan = plan_session(session, rig)
        plant = flight.devices.backends[0]._plant  # type: ignore[attr-defined]
        errors = SensorErrors(len(x), 1.0 / rate_hz)
        sensors = SpoiltSensors(flight.devices.sensors, plant, errors, shape_matrix(x, y))
        sensors.line, sensors.begin = line, _begin(plan, phase, share)
        sensors.missing_from = sensors.begin + round(missing[0] * rate_hz)
        sensors.missing = missing[1]
        flight.loop._devices = replace(flight.devices, sensors=sensors)
        try:
            flight.fly(plan, Path(folder), {})
        except FlightFault as fault:
            at = round(fault.time_s * rate_hz) + 1  # the loop flies on, at zero force
            later = flight._ring.last(max(len(sensors.true_m) - at - _SETTLED_CYCLES, 1)).rows
            return Found(
                fault.fault.name,
                fault.detail,
                at - sensors.begin + 1,
                sensors.true_m[at - 1],
                float(np.abs(later["coil_readback_n"]).max()),
            )
        return Found("", "", 0, sensors.true_m[-1], 0.0)


def _begin(plan: Plan, phase: str, share: float) -> int:
    """Return the number of the cycle, from 1 on, after a share of a phase."""
    cycle, found = 0, []
    for step in plan.steps:
        for segment in step.segments():
            name = {
                State.IDLE: "idle", State.EXCITING: "excitation", State.MOVING: "move",
                State.LANDING: "landing",
            }.get(segment.state, "hover" if segment.airborne else "lift-off")  # fmt: skip
            if name == phase and not (phase == "idle" and found):
                found += range(cycle + 1, cycle + segment.cycles + 1)
            cycle += segment.cycles
    return found[int(share * (len(found) - 1))]
