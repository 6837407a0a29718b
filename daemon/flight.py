"""A flight: devices, loop and recorder together, and a session flown from lift-off to landing."""

from __future__ import annotations

import gc
import json
import platform
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..config.rig import RigConfig
from ..drivers.base import Context, Devices
from ..drivers.registry import open_devices
from ..log.signals import cycle_dtype
from . import trajectory
from .clock import Clock, RealClock, VirtualClock
from .control import Controller
from .faults import Fault, FlightFault
from .loop import Loop
from .plan import Plan, PlannedStep
from .recorder import LogFile, Recorder
from .ring import Ring
from .segment import Segment, idle_segment
from .states import State

Array = NDArray[np.float64]

_RING_S = 4.0
_RING_AT_LEAST = 16_384
_AFTER_FAULT_S = 0.5

# step name, cycles done, cycles of the whole session
Progress = Callable[[str, int, int], None]


class RecordingError(Exception):
    """The flight went well but its log did not."""


@dataclass(frozen=True)
class FlightResult:
    """What a session left behind: its logs in order, its records, and the loop's misses.

    `stopped`: it was asked to land before its end.
    """

    logs: tuple[Path, ...]
    records: tuple[Path, ...]
    cycles: int
    late: int
    lost: int
    stopped: bool = False


class Flight:
    """The rig in flight, on a clock: a context manager that always ends in zero force."""

    def __init__(self, rig: RigConfig, folder: Path, rate_hz: float, clock: Clock) -> None:
        period_s = 1.0 / rate_hz
        self._rig, self._rate_hz, self._clock = rig, rate_hz, clock
        self.devices: Devices = open_devices(Context(rig, period_s, folder))
        geometry = rig.geometry
        dtype = cycle_dtype(len(geometry.coil_x_m), len(geometry.sensors_x_m))
        self._ring = Ring(dtype, max(int(_RING_S * rate_hz), _RING_AT_LEAST))
        self._controller = Controller(rig, period_s)
        self._recorder = Recorder(self._ring, rate_hz)
        self.loop = Loop(
            self._controller,
            self.devices,
            clock,
            self._ring,
            period_s,
            self._recorder.wait_for_room,
            rig.limits,
        )

    def __enter__(self) -> Flight:
        """Compile the cycle, read the manipulator's place once, start clock and recorder."""
        self._warm_up()
        if self._clock.real:
            # A collection of all that was ever imported stalls the loop by many periods.
            gc.collect()
            gc.freeze()
        self._clock.start()
        self._recorder.start(self._clock.epoch_ns)
        return self

    def __exit__(self, *_: object) -> None:
        """Zero force, close devices, write what is left."""
        self.loop.zero()
        try:
            self.devices.close()
        finally:
            self._recorder.close()
            if self._clock.real:
                gc.unfreeze()

    @property
    def beam_m(self) -> float:
        """Where the beam is, as last read."""
        return float(self._controller.beam[0])

    @property
    def rotor_rad(self) -> float:
        """Where the rotor is, as last read."""
        return float(self._controller.rotor[0])

    def latch(self, fault: Fault) -> None:
        """Log `fault` in every row from now on; Fault.NONE clears it."""
        self._controller.latch(fault)

    def idle(self, cycles: int) -> Fault:
        """Take readings at zero force for some cycles."""
        return self.loop.fly(self._idle_segment(cycles))

    def fly(
        self,
        plan: Plan,
        out: Path,
        attachments: Mapping[str, bytes],
        progress: Progress | None = None,
    ) -> FlightResult:
        """Fly `plan`; one log a step in `out`, each with `attachments` at its head.

        In real time all segments are computed before the first cycle; in virtual time one step at
        a time. A stop request (`loop.stop_requested`) goes on to landing at once.

        Raises:
            FlightFault: the flight ended in a fault; forces are zero, logs are closed.
            RecordingError: the log could not be written; the session was flown and landed.
        """
        self._recorder.forget_errors()
        prepared = {step.index: step.segments for step in plan.steps}
        if self._clock.real:
            prepared = {step.index: _ready(step.segments()) for step in plan.steps}
            # What the computing took is no late cycle of the flight: one at zero force absorbs it.
            self.idle(1)
        begin, late, lost = self.loop.cycle + 1, self.loop.late, self._ring.lost

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
            file = LogFile(path, self._metadata(plan, step), attachments)
            segments = prepared[step.index]
            if self.loop.stop_requested:
                segments = _ready(self._landing_from_here(segments()))
            self._fly_step(step, segments, file, tell)
            stopped |= self.loop.stop_requested and step.kind != "land"
        # The files are complete only once the recorder has caught up.
        self._recorder.shut()
        self._recorder.settle()
        if self._recorder.error is not None:
            raise RecordingError(f"recording failed: {self._recorder.error}")
        return FlightResult(
            tuple(logs),
            tuple(records),
            self.loop.cycle + 1 - begin,
            self.loop.late - late,
            self._ring.lost - lost,
            stopped,
        )

    def _landing_from_here(self, planned: list[Segment]) -> list[Segment]:
        """Return a landing that brakes beam and rotor where they are, not where the plan ends."""
        limits, control = self._rig.limits, self._controller
        Ts_s = 1.0 / self._rate_hz
        (beam_m, beam_m_s), (rotor_rad, rotor_rad_s) = control.beam_ref[:2], control.rotor_ref[:2]
        beam = trajectory.brake(beam_m, beam_m_s, limits.beam_acceleration_m_s2, Ts_s)
        rotor = trajectory.brake(rotor_rad, rotor_rad_s, limits.rotor_acceleration_rad_s2, Ts_s)
        first, *others = planned
        return [
            replace(first, beam=beam, rotor=rotor),
            *(replace(s, beam=beam[-1:], rotor=rotor[-1:]) for s in others),
        ]

    def _metadata(self, plan: Plan, step: PlannedStep) -> dict[str, str]:
        return {
            "format": "1",
            "kind": step.kind,
            "name": step.name,
            "step": str(step.index),
            "session": plan.name,
            "rate_hz": repr(self._rate_hz),
        }

    def _fly_step(
        self,
        step: PlannedStep,
        segments: Callable[[], list[Segment]],
        file: LogFile,
        tell: Callable[[str], None],
    ) -> None:
        computed = segments()
        self._recorder.open(file)
        for segment in computed:
            fault = self.loop.fly(segment)
            tell(step.name)
            if fault:
                at_s, detail = self.loop.cycle / self._rate_hz, self._detail(fault)
                self._stay_in_fault(fault)
                self._recorder.shut()
                self._recorder.settle()
                raise FlightFault(fault, at_s, step.name, detail)
            if self.loop.stop_requested and not segment.lands:
                return

    def _detail(self, fault: Fault) -> str:
        if fault is not Fault.GAP:
            return self.loop.detail
        gap = np.abs(self._controller.gap_m)
        return f"{1e3 * gap.max():.3f} mm at sensor {gap.argmax()}"

    def _stay_in_fault(self, fault: Fault) -> None:
        """Log what happens after a fault, at zero force, for as long as the devices answer."""
        self._controller.latch(fault)
        cycles = int(_AFTER_FAULT_S * self._rate_hz)
        self.loop.fly(replace(self._idle_segment(cycles), state=State.FAULT))
        self.loop.zero()

    def _idle_segment(self, cycles: int) -> Segment:
        beam, rotor = self._still
        return idle_segment(cycles, len(self._controller.coil_n), beam, rotor)

    @property
    def _still(self) -> tuple[Array, Array]:
        """Setpoints (3,) at rest where beam and rotor were last told to be."""
        at = self._controller.beam_ref[0], self._controller.rotor_ref[0]
        return np.array([at[0], 0.0, 0.0]), np.array([at[1], 0.0, 0.0])

    def _warm_up(self) -> None:
        """Run the compiled cycle once on made-up readings, so that no flight pays for compiling."""
        self._controller.begin(self._idle_segment(1))
        self._controller.step(self._ring.rows, 0, 0, 0.0, 0)
        self._controller.halt()
        for sync in self.devices.syncs:
            sync(0)
        self.devices.drives.read(self._controller.beam, self._controller.rotor)
        # Once, and never again: from here on the manipulator stays where it was last told to be.
        reach = self._rig.limits.beam_m
        self._controller.beam_ref[0] = np.clip(np.nan_to_num(self.beam_m), -reach, reach)
        self._controller.rotor_ref[0] = np.nan_to_num(self.rotor_rad)


def _ready(segments: list[Segment]) -> Callable[[], list[Segment]]:
    return lambda: segments


def flight_clock(virtual: bool, rate_hz: float) -> Clock:
    """Return the clock to fly on."""
    return VirtualClock() if virtual else RealClock(1.0 / rate_hz)


def attachments(rig_text: bytes, session_text: bytes) -> dict[str, bytes]:
    """Return what goes to the head of every log: the configs, versions and the host."""
    return {
        "rig.yaml": rig_text,
        "session.yaml": session_text,
        "versions.json": json.dumps(_versions(), indent=1, sort_keys=True).encode(),
        "host.json": json.dumps(_host(), indent=1, sort_keys=True).encode(),
    }


def _versions() -> dict[str, str]:
    found = {"python": platform.python_version()}
    for package in ("levid", "numpy", "scipy", "numba", "mcap"):
        try:
            found[package] = version(package)
        except PackageNotFoundError:
            found[package] = "not installed"
    return found


def _host() -> dict[str, str]:
    return {
        "host": platform.node(),
        "system": platform.platform(),
        "machine": platform.machine(),
        "byteorder": sys.byteorder,
    }
