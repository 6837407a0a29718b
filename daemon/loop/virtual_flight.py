"""A flight in virtual time: devices, loop and recorder in one process, from lift-off to landing."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...config.rig import RigConfig
from ...drivers.base import Context, Devices
from ...drivers.registry import open_devices
from ...log.signals import cycle_dtype
from ..control.coil_check import coil_check
from ..control.control_cycle import Controller
from ..control.faults import Fault, FlightFault
from ..control.segment import Segment
from ..control.states import State
from ..ipc.row_ring import NO_LOG, Ring, ring_rows
from ..planning import point_to_point
from ..planning.plan import Plan, PlannedStep
from ..recording.log_router import LogFile
from ..recording.recorder_thread import Recorder
from ..recording.session_logs import FlightResult, RecordingError, log_metadata
from .clock import VirtualClock
from .virtual_loop import VirtualLoop
from .warm_up import resting_segment, warm_up

_RING_AT_LEAST = 16_384
_AFTER_FAULT_S = 0.5

# step name, cycles done, cycles of the whole session
Progress = Callable[[str, int, int], None]


class Flight:
    """The rig in flight: a context manager that always ends in zero force.

    After a fault it flies no more; the daemon, which does, is Supervisor.
    """

    def __init__(self, rig: RigConfig, folder: Path, rate_hz: float, clock: VirtualClock) -> None:
        period_s = 1.0 / rate_hz
        self._rig, self._rate_hz, self._clock = rig, rate_hz, clock
        self.devices: Devices = open_devices(Context(rig, period_s, folder))
        geometry = rig.geometry
        dtype = cycle_dtype(len(geometry.coil_x_m), len(geometry.sensors_x_m))
        self._ring = Ring(dtype, max(ring_rows(rig.recording, rate_hz), _RING_AT_LEAST))
        self._controller = Controller(rig, period_s)
        self._recorder = Recorder(self._ring, rate_hz)
        self.loop = VirtualLoop(
            self._controller, self.devices, self._ring, period_s, self._recorder.wait_for_room
        )

    def __enter__(self) -> Flight:
        """Compile the cycle, read the manipulator's place once, start the recorder."""
        warm_up(self._controller, self.devices, self._ring.rows[:1], self._rig)
        self._recorder.start(self._clock.epoch_ns)
        return self

    def __exit__(self, *_: object) -> None:
        """Zero force, close devices, write what is left."""
        self.loop.zero()
        try:
            self.devices.close()
        finally:
            self._recorder.close()

    @property
    def beam_m(self) -> float:
        """Where the beam is, as last read."""
        return float(self._controller.beam[0])

    @property
    def rotor_rad(self) -> float:
        """Where the rotor is, as last read."""
        return float(self._controller.rotor[0])

    def idle(self, cycles: int) -> Fault:
        """Take readings at zero force for some cycles."""
        return self.loop.fly(resting_segment(self._controller, cycles))

    def fly(
        self,
        plan: Plan,
        out: Path,
        attachments: Mapping[str, bytes],
        progress: Progress | None = None,
    ) -> FlightResult:
        """Fly `plan`; one log a step in `out`, each with `attachments` at its head.

        A stop request (`loop.stop_requested`) goes on to landing at once.

        Raises:
            FlightFault: the flight ended in a fault; forces are zero, logs are closed.
            RecordingError: the log could not be written; the session was flown and landed.
        """
        self._recorder.forget_errors()
        begin, lost = self.loop.cycle + 1, self._ring.lost

        def tell(name: str) -> None:
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
            self._fly_step(step, segments, file, tell)
            stopped |= self.loop.stop_requested and step.kind != "land"
        # The files are complete only once the recorder has caught up.
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
        """Return a landing that brakes beam and rotor where they are, not where the plan ends."""
        if not self._controller.engaged:  # there is nothing to land
            return [segment for segment in planned if not segment.lands]
        beam, rotor = self._brakes()
        first, *others = planned
        return [
            replace(first, beam=beam, rotor=rotor),
            *(replace(s, beam=beam[-1:], rotor=rotor[-1:]) for s in others),
        ]

    def _brakes(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return setpoints (n, 3) that bring beam and rotor to rest from where they are."""
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
        tell: Callable[[str], None],
    ) -> None:
        self._record(file)
        for segment in segments:
            fault = self.loop.fly(segment) or self._check(segment)
            tell(step.name)
            if fault:
                at_s, detail = self.loop.cycle / self._rate_hz, self._detail(fault)
                self._stay_in_fault(fault)
                self._record(None)
                raise FlightFault(fault, at_s, step.name, detail)
            if self.loop.stop_requested and not segment.lands:
                return

    def _check(self, segment: Segment) -> Fault:
        """Judge what a segment that checks coils has shown."""
        if segment.checks is None or self.loop.stop_requested:
            return Fault.NONE
        rows = self._ring.last(segment.cycles).rows
        self.loop.detail = coil_check(rows, segment.checks, self._rig.geometry).error
        if not self.loop.detail:
            return Fault.NONE
        self.loop.zero()
        return Fault.COIL_CHECK

    def _record(self, file: LogFile | None) -> None:
        """Log into `file` from here on; without one, wait until all is in its files."""
        if file is not None:
            self.loop.tag = self._recorder.define(file)
            return
        self.loop.tag = NO_LOG
        self._recorder.finish()

    def _detail(self, fault: Fault) -> str:
        return self._controller.detail(fault) or self.loop.detail

    def _stay_in_fault(self, fault: Fault) -> None:
        """Log what happens after a fault, at zero force, for as long as the devices answer."""
        self._controller.latch(fault)
        cycles = int(_AFTER_FAULT_S * self._rate_hz)
        resting = resting_segment(self._controller, cycles)
        beam, rotor = self._brakes()
        self.loop.fly(replace(resting, state=State.FAULT, beam=beam, rotor=rotor))
        self.loop.zero()
