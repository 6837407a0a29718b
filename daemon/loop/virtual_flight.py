"""Fly a plan in virtual time: devices, loop and recorder in one process."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...config.rig import RigConfig
from ...drivers.base import Context, Devices
from ...drivers.open_backends import open_devices
from ...log.signals import cycle_dtype
from ..control.coil_check import coil_check
from ..control.control_cycle import Controller
from ..control.faults import Fault, FlightFault
from ..control.flight_segment import Segment
from ..control.states import State
from ..ipc.row_ring import NO_LOG, Ring, ring_rows
from ..planning import point_to_point
from ..planning.plan import Plan, PlannedStep
from ..recording.log_metadata import FlightResult, RecordingError, log_metadata
from ..recording.log_router import LogFile
from ..recording.virtual_time_recorder import Recorder
from .clock import VirtualClock
from .prepare_first_cycle import resting_segment, warm_up
from .virtual_loop import VirtualLoop

_MIN_RING_ROWS = 16_384
_AFTER_FAULT_S = 0.5

# step name, cycles flown, cycles of the session
Progress = Callable[[str, int, int], None]


class Flight:
    """Fly plans in virtual time; a context manager that always ends in zero force.

    It cannot clear a fault: create a new one.
    """

    def __init__(self, rig: RigConfig, folder: Path, rate_hz: float, clock: VirtualClock) -> None:
        period_s = 1.0 / rate_hz
        self._rig, self._rate_hz, self._clock = rig, rate_hz, clock
        self.devices: Devices = open_devices(Context(rig, period_s, folder))
        geometry = rig.geometry
        dtype = cycle_dtype(len(geometry.coil_x_m), len(geometry.sensors_x_m))
        self._ring = Ring(dtype, max(ring_rows(rig.recording, rate_hz), _MIN_RING_ROWS))
        self._controller = Controller(rig, period_s)
        self._recorder = Recorder(self._ring, rate_hz)
        self.loop = VirtualLoop(
            self._controller, self.devices, self._ring, period_s, self._recorder.wait_for_room
        )

    def __enter__(self) -> Flight:
        """Compile the cycle, read the manipulator position once, start the recorder."""
        warm_up(self._controller, self.devices, self._ring.rows[:1], self._rig)
        self._recorder.start(self._clock.epoch_ns)
        return self

    def __exit__(self, *_: object) -> None:
        """Command zero force, close the devices, write the remaining rows."""
        self.loop.zero()
        try:
            self.devices.close()
        finally:
            self._recorder.close()

    @property
    def beam_m(self) -> float:
        """Last reading of the beam position in m."""
        return float(self._controller.beam[0])

    @property
    def rotor_rad(self) -> float:
        """Last reading of the rotor position in rad."""
        return float(self._controller.rotor[0])

    def idle(self, cycles: int) -> Fault:
        """Run `cycles` cycles at zero force; return the fault."""
        return self.loop.fly(resting_segment(self._controller, cycles))

    def fly(
        self,
        plan: Plan,
        out: Path,
        attachments: Mapping[str, bytes],
        progress: Progress | None = None,
    ) -> FlightResult:
        """Fly `plan`; write one log per step into `out`, each with `attachments`.

        A stop request (`loop.stop_requested`) leads to an immediate landing.

        Raises:
            FlightFault: the flight ended in a fault; forces are zero, logs are closed.
            RecordingError: a log could not be written; the session was flown and landed.
        """
        self._recorder.forget_errors()
        begin, lost = self.loop.cycle + 1, self._ring.lost

        def report(name: str) -> None:
            if progress is not None:
                progress(name, self.loop.cycle + 1 - begin, plan.cycles)

        logs: list[Path] = []
        records: list[Path] = []
        stopped = False
        for step in plan.steps:
            if self.loop.stop_requested and step.kind != "land":
                continue
            path = out / f"{step.index:02d}-{step.name}.mcap"
            logs.append(path)
            if step.kind == "record":
                records.append(path)
            segments = step.segments()
            if self.loop.stop_requested:
                segments = self._landing_from_here(segments)
            file = LogFile(path, log_metadata(plan, step), attachments)
            self._fly_step(step, segments, file, report)
            stopped |= self.loop.stop_requested and step.kind != "land"
        # Wait until the recorder has written all rows.
        self._record(None)
        if self._recorder.error is not None:
            raise RecordingError(f"recording failed: {self._recorder.error}")
        return FlightResult(
            tuple(logs),
            tuple(records),
            self.loop.cycle + 1 - begin,
            0,
            self._ring.lost - lost,
            stopped,
        )

    def _landing_from_here(self, planned: list[Segment]) -> list[Segment]:
        """Return the planned landing, but with beam and rotor braking from their present motion."""
        if not self._controller.engaged:  # not in flight
            return [segment for segment in planned if not segment.lands]
        beam, rotor = self._brakes()
        first, *others = planned
        return [
            replace(first, beam=beam, rotor=rotor),
            *(replace(s, beam=beam[-1:], rotor=rotor[-1:]) for s in others),
        ]

    def _brakes(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return setpoints (n, 3) that brake beam and rotor from their present motion."""
        limits, control = self._rig.limits, self._controller
        Ts_s = 1.0 / self._rate_hz
        (beam_m, beam_m_s), (rotor_rad, rotor_rad_s) = control.beam_ref[:2], control.rotor_ref[:2]
        return (
            point_to_point.brake(beam_m, beam_m_s, limits.beam_acceleration_m_s2, Ts_s),
            point_to_point.brake(rotor_rad, rotor_rad_s, limits.rotor_acceleration_rad_s2, Ts_s),
        )

    def _fly_step(
        self,
        step: PlannedStep,
        segments: list[Segment],
        file: LogFile,
        report: Callable[[str], None],
    ) -> None:
        self._record(file)
        for segment in segments:
            fault = self.loop.fly(segment) or self._check_coils(segment)
            report(step.name)
            if fault:
                at_s, detail = self.loop.cycle / self._rate_hz, self._detail(fault)
                self._stay_in_fault(fault)
                self._record(None)
                raise FlightFault(fault, at_s, step.name, detail)
            if self.loop.stop_requested and not segment.lands:
                return

    def _check_coils(self, segment: Segment) -> Fault:
        """Evaluate the coil check of a segment, if it has one; return the fault."""
        if segment.checks is None or self.loop.stop_requested:
            return Fault.NONE
        rows = self._ring.last(segment.cycles).rows
        self.loop.detail = coil_check(rows, segment.checks, self._rig.geometry).error
        if not self.loop.detail:
            return Fault.NONE
        self.loop.zero()
        return Fault.COIL_CHECK

    def _record(self, file: LogFile | None) -> None:
        """Log into `file` from now on; without a file, wait until all rows are written."""
        if file is not None:
            self.loop.tag = self._recorder.define(file)
            return
        self.loop.tag = NO_LOG
        self._recorder.finish()

    def _detail(self, fault: Fault) -> str:
        return self.loop.detail or self._controller.detail(fault)

    def _stay_in_fault(self, fault: Fault) -> None:
        """Log half a second after a fault at zero force, as long as the devices respond."""
        self._controller.latch(fault)
        cycles = int(_AFTER_FAULT_S * self._rate_hz)
        resting = resting_segment(self._controller, cycles)
        beam, rotor = self._brakes()
        self.loop.fly(replace(resting, state=State.FAULT, beam=beam, rotor=rotor))
        self.loop.zero()
