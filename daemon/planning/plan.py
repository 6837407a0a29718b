"""Plan a session as segments for the loop, before the flight."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from ...config.base import ConfigError
from ...config.rig import RigConfig
from ...config.session import CoilCheck, Land, Levitate, Move, RecordStep, SessionConfig, Step
from ...model.geometry import decoupling_matrix
from ..control.coil_check import LONGER, Pushes
from ..control.feed_forward import feed_forward
from ..control.flight_segment import Segment, idle_segment
from ..control.states import State
from ..ipc.row_ring import ring_rows
from . import point_to_point
from .orthogonal_multisine import orthogonal_cycles
from .record_excitation import RecordExcitation, cycles_of

Array = NDArray[np.float64]
Progress = Callable[[str, int], None]

_IDLE_S = 0.3
_JUDGED_S = 2.0
"""Longest delay of the evaluation of a coil check; its rows must stay in the ring until then."""
MOST_CYCLES = 30_000_000
"""Longest record, and longest session of a daemon: 50 min at 10 kHz, arrays of several GB."""
MOST_NOTE = 1000
"""Longest note of the user on a flight, in characters."""
_FLYING = np.array([[1.0, 1.0, 1.0]])


@dataclass(frozen=True)
class PlannedStep:
    """Plan one step of a session; `segments()` computes its arrays, GB for records of hours.

    `excitation` computes that of a record block by block; it is None where nothing is excited, and
    if the plan was read from a file. `beam_m` is where the beam is at the start of the step.
    `disturbing_beam` is the beam's motion if the feed-forward does not carry it.
    """

    index: int
    kind: Literal["levitate", "move", "record", "land"]
    name: str
    cycles: int
    segments: Callable[[], list[Segment]]
    beam_m: float = 0.0
    excitation: RecordExcitation | None = None
    disturbing_beam: point_to_point.Repeated | None = None


@dataclass(frozen=True)
class Plan:
    """Hold the planned steps of a session at one rate."""

    name: str
    rate_hz: float
    steps: tuple[PlannedStep, ...]
    note: str = ""
    """Note of the user on this flight, for its logs."""

    @property
    def cycles(self) -> int:
        """Cycles of all steps."""
        return sum(step.cycles for step in self.steps)


def checked_note(text: object) -> str:
    """Return the user's note on a flight; raise ConfigError if it does not fit into a log."""
    if text is None:
        return ""
    if not isinstance(text, str):
        raise ConfigError("note: expected a line of text, found another value")
    if len(text) > MOST_NOTE:
        raise ConfigError(f"note: expected at most {MOST_NOTE} characters, found {len(text)}")
    if not text.isprintable():
        raise ConfigError(
            "note: expected one line of text, found a line break or control character"
        )
    return text


def plan_session(
    session: SessionConfig,
    rig: RigConfig,
    beam_m: float = 0.0,
    rotor_rad: float = 0.0,
    source: str | None = None,
    check: CoilCheck | None = None,
    report: Progress = lambda _, __: None,
) -> Plan:
    """Plan `session` on `rig`, with the manipulator initially at rest at `beam_m`, `rotor_rad`.

    `source` names the session in errors, usually its file. `check` is the coil check of a lift-off
    that does not set `check_coils`. `report` gets the name of a record and the number of its cycles
    that were checked since the last call; a record of hours takes seconds.

    Raises:
        ConfigError: a position or speed exceeds the rig's limits, a coil does not exist, or a level
            would saturate the coils; the message names session, step and key.
    """
    return _Planner(session, rig, beam_m, rotor_rad, source, check, report).plan()


def plan_steps(
    steps: Sequence[Step],
    name: str,
    rig: RigConfig,
    beam_m: float,
    rotor_rad: float,
    check: CoilCheck | None = None,
) -> Plan:
    """Plan single steps of a flight by hand; see plan_session."""
    session = SessionConfig.model_construct(
        levid="session",
        name=name,
        rate_hz=None,
        seed=1,
        excitations={},
        steps=tuple(steps),
        then=(),
    )
    return _Planner(session, rig, beam_m, rotor_rad, name, check).plan()


class _Planner:
    def __init__(
        self,
        session: SessionConfig,
        rig: RigConfig,
        beam_m: float,
        rotor_rad: float,
        source: str | None,
        check: CoilCheck | None,
        report: Progress = lambda _, __: None,
    ) -> None:
        self.session, self.rig, self.check, self.report = session, rig, check, report
        self.source = source or f"session {session.name}"
        self.rate_hz = session.rate_hz or rig.rate_hz
        self.feed_forward = feed_forward(rig, 1.0 / self.rate_hz)
        self.beam_m, self.rotor_rad = beam_m, rotor_rad
        self.coils = len(rig.geometry.coil_x_m)
        self.T_coils = decoupling_matrix(rig.geometry.coil_x_m, rig.geometry.coil_y_m)
        self.no_v, self.no_coils = np.zeros((1, 3)), np.zeros((1, self.coils))

    def plan(self) -> Plan:
        steps: list[PlannedStep] = []
        for index, step in enumerate(self.session.steps):
            where = f"{self.source}: steps[{index}].{step.kind}"
            try:
                steps.append(self.step(step, index, where))
            except (ValueError, OverflowError) as error:
                raise ConfigError(f"{where}: {error}") from None
        return Plan(self.session.name, self.rate_hz, tuple(steps))

    def step(self, step: Step, index: int, where: str) -> PlannedStep:
        excitation, disturbing_beam, beam_m = None, None, self.beam_m
        if step.levitate is not None:
            cycles, segments = self.levitate(step.levitate, where)
        elif step.move is not None:
            cycles, segments = self.move(step.move, where)
        elif step.record is not None:
            played = self.excitation(step.record, index, where)
            beam = self.beam_trajectory(step.record, played.cycles, where)
            cycles, segments = self.record(step.record, played, beam, where)
            excitation = played if step.record.excite else None
            disturbing_beam = None if step.record.beam_feedforward else beam
        else:
            cycles, segments = self.land(step.land or Land())
        name = step.record.name if step.record else step.kind
        return PlannedStep(
            index, step.kind, name, cycles, segments, beam_m, excitation, disturbing_beam
        )

    def levitate(self, step: Levitate, where: str) -> tuple[int, Callable[[], list[Segment]]]:
        idle, settle = self.n(_IDLE_S), self.n(step.settle_s)
        unload, ramp = self.n(step.unload_s), self.n(step.ramp_s)
        beam, rotor = self.still()
        checks: list[Segment] = []
        check = self.check if step.check_coils is None else step.check_coils or None
        if check is not None:
            pushes = Pushes.of(check, self.coils, self.rate_hz)
            self.check_length(check, pushes, f"{where}.check_coils")
            pushed = pushes.excitation()
            self.check_levels(float(np.abs(pushed).max()), beam, f"{where}.check_coils")
            flying = self.flying(State.LEVITATING, len(pushed), beam, rotor)
            checks = [replace(flying, coil_excitation=pushed, checks=pushes)]

        def segments() -> list[Segment]:
            up = np.concatenate([np.zeros(unload), _smooth(ramp)])
            share = np.concatenate([_smooth(unload), np.ones(ramp)])
            blend = np.stack([up, share, np.ones(unload + ramp)], axis=1)
            return [
                idle_segment(idle, self.coils, beam, rotor),
                self.flying(
                    State.LEVITATING, unload + ramp, beam, rotor, blend, False, engages=True
                ),
                *checks,
                self.flying(State.LEVITATING, settle, beam, rotor),
            ]

        pushing = sum(check.cycles for check in checks)
        return idle + unload + ramp + pushing + settle, segments

    def move(self, step: Move, where: str) -> tuple[int, Callable[[], list[Segment]]]:
        limits = self.rig.limits
        beam, rotor = self.still()
        if step.beam_m is not None:
            beam = self.beam_move(
                step.beam_m, step.velocity_m_s, step.acceleration_m_s2, f"{where}.beam_m"
            )
        if step.rotor_rad is not None:
            rotor = point_to_point.move(
                self.rotor_rad,
                step.rotor_rad,
                limits.rotor_velocity_rad_s,
                limits.rotor_acceleration_rad_s2,
                1 / self.rate_hz,
            )
            self.rotor_rad = step.rotor_rad
        moving, settle = max(len(beam), len(rotor)), self.n(step.settle_s)

        def segments() -> list[Segment]:
            return [
                self.flying(State.MOVING, moving, beam, rotor),
                self.flying(State.LEVITATING, settle, beam[-1:], rotor[-1:]),
            ]

        return moving + settle, segments

    def excitation(self, step: RecordStep, index: int, where: str) -> RecordExcitation:
        """Return the excitation of a record; raise ConfigError if the record is too long."""
        n = self.record_cycles(step)
        if n > MOST_CYCLES:
            key = next(k for k in ("duration_s", "orthogonal", "each_s") if getattr(step, k))
            raise ConfigError(
                f"{where}.{key}: expected at most {MOST_CYCLES / self.rate_hz:g} s at "
                f"{self.rate_hz:g} Hz, found {n / self.rate_hz:g} s; fly several records"
            )
        return RecordExcitation(
            self.session, step, index, n, self.rate_hz, self.coils, self.source, where
        )

    def record(
        self,
        step: RecordStep,
        excitation: RecordExcitation,
        beam: point_to_point.Repeated | None,
        where: str,
    ) -> tuple[int, Callable[[], list[Segment]]]:
        n, settle = excitation.cycles, self.n(step.settle_s)
        beam_before, rotor_before = self.still()
        if beam is not None:
            self.beam_m = beam.end
        rotor = self.rotor_trajectory(step, n, where) if step.rotor else None
        moves = bool(step.beam or step.rotor)
        state = State.MOVING if moves and not step.excite else State.EXCITING

        def segments() -> list[Segment]:
            # The feed-forward of the whole log is the same: identification sees no step in it.
            settling = self.flying(State.LEVITATING, settle, beam_before, rotor_before)
            recording = Segment(
                state,
                n,
                *excitation.arrays(),
                _FLYING,
                beam_before if beam is None else beam.setpoints(),
                rotor_before if rotor is None else rotor.setpoints(),
            )
            return [
                replace(segment, beam_feedforward=step.beam_feedforward)
                for segment in (settling, recording)
            ]

        peak_n = excitation.peak_n(self.T_coils, partial(self.report, step.name))
        self.check_levels(peak_n, beam_before if beam is None else beam.moves(), where)
        return settle + n, segments

    def land(self, step: Land) -> tuple[int, Callable[[], list[Segment]]]:
        ramp, release, idle = self.n(step.ramp_s), self.n(step.release_s), self.n(_IDLE_S)
        beam, rotor = self.still()

        def segments() -> list[Segment]:
            down = _smooth(ramp)[::-1]
            sink = np.stack([down, np.ones(ramp), np.ones(ramp)], axis=1)
            out = _smooth(release)[::-1]
            let_go = np.stack([np.zeros(release), np.ones(release), out], axis=1)
            return [
                self.flying(State.LANDING, ramp, beam, rotor, sink, False, lands=True),
                self.flying(State.LANDING, release, beam, rotor, let_go, False, lands=True),
                idle_segment(idle, self.coils, beam, rotor),
            ]

        return ramp + release + idle, segments

    def record_cycles(self, step: RecordStep) -> int:
        if step.orthogonal is not None:
            first = self.session.excitations[step.excite[0]]
            return orthogonal_cycles(
                first, len(step.excite), step.orthogonal, step.fade_s, self.rate_hz
            )
        if step.each_s is not None:
            return len(step.excite) * self.n(step.each_s) + self.n(step.fade_s)
        assert step.duration_s is not None
        return self.n(step.duration_s)

    def check_length(self, check: CoilCheck, pushes: Pushes, where: str) -> None:
        """Raise ConfigError if a push is shorter than a period or the check exceeds the ring.

        All rows of the check must still be in the ring when it is evaluated.
        """
        if LONGER * check.push_s * self.rate_hz < 1.0:
            raise ConfigError(
                f"{where}.push_s: expected a push of at least one period, "
                f"{1 / self.rate_hz:.3g} s, found {check.push_s:g} s"
            )
        longest_s = ring_rows(self.rig.recording, self.rate_hz) / self.rate_hz - _JUDGED_S
        found_s = pushes.coils * pushes.turn / self.rate_hz
        if found_s > longest_s:
            raise ConfigError(
                f"{where}: expected the pushes of all {pushes.coils} coils within "
                f"{longest_s:.1f} s, found {found_s:.1f} s; reduce pause_s or push_s, or increase "
                "recording.before_fault_s in RIG.yaml, because the check needs all its rows in "
                "memory"
            )

    def check_levels(self, played: float, beam: Array, where: str) -> None:
        """Raise ConfigError if weight and excitation (peak in N) exceed the coil force limit."""
        limit = self.rig.limits.coil_n
        weight = self.feed_forward.wrench(np.atleast_2d(beam))
        carried = float(np.max(np.abs(weight @ self.T_coils)))
        if not carried + played <= limit:  # nan is an error too
            raise ConfigError(
                f"{where}: the excitation would saturate the coils: expected at most {limit:g} N "
                f"a coil, found {carried:.1f} N of weight and {played:.1f} N of excitation at its "
                f"peak; lower rms_n or rms_n_m by a factor of "
                f"{played / max(limit - carried, 1e-9):.1f} or more"
            )

    def beam_trajectory(
        self, step: RecordStep, n: int, where: str
    ) -> point_to_point.Repeated | None:
        """Return the beam's motion for n cycles, which repeats its waypoints; None without any."""
        if not step.beam:
            return None
        legs = [
            self.beam_leg(
                point.to_m,
                point.velocity_m_s,
                point.acceleration_m_s2,
                point.dwell_s,
                f"{where}.beam[{number}].to_m",
            )
            for number, point in enumerate(step.beam)
        ]
        try:
            return point_to_point.Repeated(self.beam_m, legs, n, 1 / self.rate_hz)
        except ValueError as error:
            raise ConfigError(f"{where}.beam[0].to_m: {error}") from None

    def rotor_trajectory(self, step: RecordStep, n: int, where: str) -> point_to_point.Repeated:
        """Return the rotor's motion for n cycles, which repeats its waypoints."""
        limits = self.rig.limits
        legs: list[point_to_point.Leg] = []
        for number, point in enumerate(step.rotor):
            velocity, acceleration = limits.rotor_velocity_rad_s, limits.rotor_acceleration_rad_s2
            at = f"{where}.rotor[{number}]"
            fast, hard = point.velocity_rad_s, point.acceleration_rad_s2
            _check_limit(f"{at}.velocity_rad_s", fast, velocity, "rad/s")
            _check_limit(f"{at}.acceleration_rad_s2", hard, acceleration, "rad/s2")
            legs.append(
                point_to_point.Leg(
                    point.to_rad, fast or velocity, hard or acceleration, point.dwell_s
                )
            )
        try:
            repeated = point_to_point.Repeated(self.rotor_rad, legs, n, 1 / self.rate_hz)
        except ValueError as error:
            raise ConfigError(f"{where}.rotor[0].to_rad: {error}") from None
        self.rotor_rad = repeated.end
        return repeated

    def beam_move(
        self, to_m: float, velocity: float | None, acceleration: float | None, where: str
    ) -> Array:
        leg = self.beam_leg(to_m, velocity, acceleration, 0.0, where)
        setpoints = point_to_point.move(
            self.beam_m, leg.to, leg.velocity, leg.acceleration, 1 / self.rate_hz
        )
        self.beam_m = to_m
        return setpoints

    def beam_leg(
        self,
        to_m: float,
        velocity: float | None,
        acceleration: float | None,
        dwell_s: float,
        where: str,
    ) -> point_to_point.Leg:
        limits = self.rig.limits
        if abs(to_m) > limits.beam_m:
            raise ConfigError(f"{where}: expected within +-{limits.beam_m:g} m, found {to_m:g} m")
        for key, value, limit, unit in (
            ("velocity_m_s", velocity, limits.beam_velocity_m_s, "m/s"),
            ("acceleration_m_s2", acceleration, limits.beam_acceleration_m_s2, "m/s2"),
        ):
            _check_limit(f"{where}: {key}", value, limit, unit)
        return point_to_point.Leg(
            to_m,
            velocity or limits.beam_velocity_m_s / 2,
            acceleration or limits.beam_acceleration_m_s2 / 10,
            dwell_s,
        )

    def flying(
        self,
        state: State,
        cycles: int,
        beam: Array,
        rotor: Array,
        blend: Array = _FLYING,
        airborne: bool = True,
        engages: bool = False,
        lands: bool = False,
    ) -> Segment:
        return Segment(
            state,
            cycles,
            self.no_v,
            self.no_coils,
            np.ascontiguousarray(blend),
            np.atleast_2d(beam),
            np.atleast_2d(rotor),
            airborne=airborne,
            engages=engages,
            lands=lands,
        )

    def still(self) -> tuple[Array, Array]:
        """Return single setpoints (1, 3) that hold beam and rotor at their last position."""
        return np.array([[self.beam_m, 0.0, 0.0]]), np.array([[self.rotor_rad, 0.0, 0.0]])

    def n(self, duration_s: float) -> int:
        """Return the cycles of a duration; at least one if it is positive."""
        return cycles_of(duration_s, self.rate_hz)


def _check_limit(where: str, value: float | None, limit: float, unit: str) -> None:
    if value is not None and value > limit:
        raise ConfigError(f"{where}: expected at most {limit:g} {unit}, found {value:g} {unit}")


def _smooth(n: int) -> Array:
    """Return n samples of a smooth step from 0 to 1 (minimum jerk)."""
    s = np.arange(1, n + 1) / n if n else np.zeros(0)
    return np.asarray(s**3 * (10.0 + s * (-15.0 + 6.0 * s)))
