"""Run one flight at a time: stream its segments to the loop, report progress and the result."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

from ...config.rig import RigConfig
from ..api.control_server import Reply
from ..control.coil_check import CoilCheckResult, coil_check
from ..control.faults import Fault, FlightFault
from ..control.flight_segment import Segment
from ..control.following_limits import off_target
from ..control.states import IN_FLIGHT, State
from ..ipc.flight_segment_stream import Logged, SegmentFeeder
from ..ipc.row_ring import NO_LOG
from ..ipc.shared_memory import SharedMemory
from ..ipc.shared_status_words import ControlWords, Word
from ..planning.plan import Plan, PlannedStep
from ..planning.refused_request import RefusedError, wrong_state
from ..recording.log_metadata import FlightResult, RecordingError
from ..recording.log_router import LogFile
from ..recording.recorder_link import RecorderLink

_PROGRESS_S = 0.5
_MISSING_ROWS = 64
"""Margin of rows: a cycle at rest that ends in a driver error writes no row."""
_WRITING_S = 60.0
"""Time limit for the recorder to write the last rows."""


@dataclass
class Job:
    """Hold a plan with its segments, its client and its counts.

    segments: those of each step, generated some seconds before they are flown.
    files: the log of each step by its index; a step without one continues the present log.
    over: called when the next job may start.
    landing: ramp and release cycles of an early landing; None keeps those of the flight.
    holds: the job ends with its plan, in flight.
    rows: first ring row and row count among which the plan starts.
    flown: cycles and late cycles up to its end.
    """

    plan: Plan
    segments: Iterable[tuple[PlannedStep, list[Segment]]]
    files: dict[int, LogFile]
    reply: Reply
    over: Callable[[], None]
    landing: tuple[int, int] | None
    land_when_gone: bool = False
    abandoned: bool = False
    begins_at_rest: bool = True
    holds: bool = False
    number: int = 0
    start_cycle: int = 0
    rows: tuple[int, int] = (0, 0)
    counts_before: tuple[int, int] = (0, 0)
    tags: dict[int, PlannedStep] = field(default_factory=dict)
    reported_s: float = 0.0
    ended_s: float | None = None
    end: int = 0
    flown: tuple[int, int] = (0, 0)
    verdict: CoilCheckResult = field(default_factory=CoilCheckResult)
    error: Exception | None = None

    def step_of(self, tag: int) -> str:
        """Return the name of the step with this log tag, or of the only step."""
        if tag in self.tags:
            return self.tags[tag].name
        return self.plan.steps[0].name if len(self.plan.steps) == 1 else ""


class JobRunner:
    """Run jobs in the supervisor's thread; `tick` never waits.

    `clients_gone` counts clients that disconnected during their flight.
    """

    def __init__(
        self,
        rig: RigConfig,
        shared: SharedMemory,
        recorder: RecorderLink,
        log: Callable[[str], None] = lambda _: None,
    ) -> None:
        self._rig, self._recorder, self._log = rig, recorder, log
        self._shared = shared
        self._control_words, self._ring, self._segment_stream = (
            shared.control_words,
            shared.ring,
            shared.segment_stream,
        )
        self._feeder: SegmentFeeder | None = None
        self._plans = 0
        self._flight_log = NO_LOG
        self.job: Job | None = None
        self.clients_gone = 0
        self._coils_checked: tuple[int, int] | None = None

    @property
    def airborne(self) -> bool:
        """Whether the platform is in flight."""
        return self._control_words.state in IN_FLIGHT

    @property
    def coils_are_known(self) -> bool:
        """Whether all coils passed a check since the start and the last fault."""
        return self._coils_checked == self._last_repair

    @property
    def _last_repair(self) -> tuple[int, int]:
        """Counts of cleared faults and loop starts, after which cables may have been changed."""
        return self._control_words[Word.CLEAR], self._control_words[Word.LOOPS]

    def begin(self, job: Job) -> None:
        """Start `job`; raises RefusedError."""
        control_words = self._control_words
        if self.job is not None:
            raise RefusedError("a session is being flown; `levid land` ends it")
        if control_words.fault is not Fault.NONE:
            raise RefusedError(in_fault(control_words))
        wanted = State.IDLE if job.begins_at_rest else State.LEVITATING
        if control_words.state is not wanted or control_words[Word.PLAN]:
            raise RefusedError(wrong_state(control_words.state, wanted))
        if job.begins_at_rest:
            self._recorder.forget()
            self._flight_log = NO_LOG
        # Define the log of the last step now: an early landing is logged there.
        before = self._flight_log
        tag = self._tag_of(job, job.plan.steps[-1], before)
        if job.holds:
            self._flight_log = tag
        self._plans += 1
        job.number = self._plans
        job.start_cycle = control_words[Word.CYCLE]
        job.counts_before = control_words[Word.LATE], self._shared.lost
        control_words[Word.LAND_LOG] = tag
        if job.landing is not None:
            control_words[Word.LAND_RAMP], control_words[Word.LAND_RELEASE] = job.landing
        self._feeder = SegmentFeeder(
            self._segment_stream, control_words, job.number, self._logged(job, before)
        )
        if self._feeder.error:
            raise RefusedError(f"the plan cannot be flown: {self._feeder.error}")
        self.job = job
        first = self._ring.head
        self._feeder.feed()
        job.rows = first, self._ring.head + 1 - first

    def _logged(self, job: Job, tag: int) -> Iterator[Logged]:
        """Yield the segments of a job; define each log before its first segment."""
        for step, segments in job.segments:
            tag = self._tag_of(job, step, tag)
            yield from (Logged(segment, tag) for segment in segments)

    def _tag_of(self, job: Job, step: PlannedStep, before: int) -> int:
        """Return the tag of a step's log, or `before` if the step has no log of its own."""
        if step.index not in job.files:
            return before
        known = {of.index: tag for tag, of in job.tags.items()}
        if step.index not in known:
            known[step.index] = self._recorder.define(job.files[step.index])
            job.tags[known[step.index]] = step
        return known[step.index]

    def tick(self) -> None:
        """Stream segments, report progress, and end the job when it is complete."""
        job, control_words = self.job, self._control_words
        if job is None:
            return
        assert self._feeder is not None
        self._feeder.feed()
        if self._feeder.error and job.error is None:
            job.error = RefusedError(f"the flight was landed early: {self._feeder.error}")
            control_words.land()
        self.note_fault()
        self._check_coils(job, self._feeder)
        now_s = time.monotonic()
        if job.ended_s is None:
            if control_words[Word.PLAN_DONE] >= job.number:
                self._end_flight(job, now_s)
            else:
                self._report_progress(job, now_s, self.step_of(job), self.share_of(job))
            if not job.reply.waiting and not job.abandoned:
                job.abandoned = True
                self._client_disconnected(job)
        elif job.holds or self._written(job) or now_s - job.ended_s > _WRITING_S:
            self._recorder.receive()  # messages sent before its last row was on disk
            if job.error is None and not job.holds and not self._written(job):
                reason = self._recorder.problem or f"not written within {_WRITING_S:g} s"
                job.error = RecordingError(f"the last rows are not on the disk: {reason}")
            self.job = self._feeder = None
            job.over()
            self._answer(job)
        else:  # keep the client from timing out
            self._report_progress(job, now_s, "writing", 1.0)

    def _client_disconnected(self, job: Job) -> None:
        self.clients_gone += 1
        action = "landing" if job.land_when_gone else "the flight goes on"
        self._log(f"the client of '{job.plan.name}' disconnected: {action}")
        if job.land_when_gone:
            self._control_words.land()

    def _report_progress(self, job: Job, now_s: float, step: str, share: float) -> None:
        if now_s - job.reported_s >= _PROGRESS_S:
            job.reported_s = now_s
            problem = self._recorder.problem or self._recorder.lost
            warning = {"warning": f"recording: {problem}"} if problem else {}
            job.reply.send({"step": step, "share": share, **warning})

    def note_fault(self) -> None:
        """Store the fault of the current job: its client gets it even if it is cleared first."""
        job, control_words = self.job, self._control_words
        if job is None or job.error is not None or job.number != control_words[Word.FAULT_PLAN]:
            return
        fault = control_words.fault
        if fault is not Fault.NONE:
            at_s = control_words[Word.FAULT_CYCLE] / self._rig.rate_hz
            step = job.step_of(control_words[Word.FAULT_LOG])
            job.error = FlightFault(fault, at_s, step, control_words.detail)

    def abort(self, fault: Fault, detail: str) -> None:
        """End the current job because the loop has ended."""
        job, control_words = self.job, self._control_words
        step = "" if job is None else self.step_of(job)  # before the words are reset
        control_words[Word.PLAN], control_words[Word.LOG] = 0, NO_LOG
        control_words[Word.PLAN_CUT] = control_words[Word.PLAN_DONE] = self._plans
        control_words[Word.QUEUE_TAIL] = control_words[Word.QUEUE_HEAD]
        if job is not None and job.ended_s is None:
            at_s = control_words[Word.CYCLE] / self._rig.rate_hz
            job.error = FlightFault(fault, at_s, step, detail)
            self._end_flight(job, time.monotonic())

    def _end_flight(self, job: Job, now_s: float) -> None:
        """Store the counts of the flight; its last rows still have to be written."""
        control_words = self._control_words
        job.ended_s, job.end = now_s, self._ring.head
        rows = self._ring.last(1).rows
        moved = not job.begins_at_rest and control_words[Word.PLAN_CUT] < job.number
        if moved and job.error is None and len(rows) and (off := off_target(rows[-1], self._rig)):
            job.error = RefusedError(f"move: {off}: the drive is too slow for settle_s, or jams")
        late = control_words[Word.LATE] - job.counts_before[0]
        job.flown = control_words[Word.CYCLE] - job.start_cycle, late

    def step_of(self, job: Job) -> str:
        """Return the name of the step that the job is flying."""
        return job.step_of(self._control_words[Word.LOG])

    def share_of(self, job: Job) -> float:
        """Return the fraction of the job that is flown, 0 to 1."""
        flown = self._control_words[Word.CYCLE] - job.start_cycle
        return min(max(flown / max(job.plan.cycles, 1), 0.0), 1.0)

    def left_s_of(self, job: Job) -> float:
        """Return the time in s until the job's plan ends; cycles that it skipped come on top."""
        flown = self._control_words[Word.CYCLE] - job.start_cycle
        return max(job.plan.cycles - flown, 0) / self._rig.rate_hz

    def _check_coils(self, job: Job, feeder: SegmentFeeder) -> None:
        """Evaluate a coil check once it is flown, while the platform settles.

        The check may be the end of its plan, and may have ended long before this call.
        """
        control_words = self._control_words
        if feeder.check is None:
            return
        pushes, cycles, last = feeder.check
        ended, flown = control_words[Word.PLAN_DONE] >= job.number, control_words[Word.ROWS_TAIL]
        if flown < last + (not ended):
            return  # the last push is not complete, or the flight ended before it
        feeder.check = None
        if job.error is not None or control_words.fault is not Fault.NONE:
            return
        # The plan started at one of `count` ring rows; the loop wrote one row per plan row since.
        first, count = job.rows
        begin = max(first + last + 1 - cycles - feeder.base - _MISSING_ROWS, 0)
        found = self._ring.copy(begin, _MISSING_ROWS + count + cycles)
        rows = found.rows if found.first == begin else found.rows[:0]  # overwritten: skip
        job.verdict = verdict = coil_check(rows, pushes, self._rig.geometry)
        if verdict.error:
            control_words.stop(Fault.COIL_CHECK, verdict.error)
            # The loop sets the fault in the next cycle, when this plan may have ended.
            at_s = control_words[Word.CYCLE] / self._rig.rate_hz
            job.error = FlightFault(Fault.COIL_CHECK, at_s, self.step_of(job), verdict.error)
        elif verdict.unjudged:
            self._log(verdict.skipped)
        else:
            self._coils_checked = self._last_repair

    def _written(self, job: Job) -> bool:
        return self._ring.durable >= job.end and self._control_words[Word.WRITING] not in job.tags

    def _answer(self, job: Job) -> None:
        """Answer the client of this job."""
        problems = [self._recorder.failed[tag] for tag in job.tags if tag in self._recorder.failed]
        if job.error is None and problems:
            job.error = RecordingError(f"recording failed: {problems[0]}")
        if job.error is not None:
            job.reply.refuse(str(job.error))
            return
        result = self._result(job)
        job.reply.done(
            logs=list(map(str, result.logs)),
            records=list(map(str, result.records)),
            cycles=result.cycles,
            late=result.late,
            lost=result.lost,
            stopped=result.stopped,
            unjudged_coils=list(result.unjudged_coils),
            coil_check=result.coil_check,
        )

    def _result(self, job: Job) -> FlightResult:
        control_words, files = self._control_words, self._recorder.files
        logs: list[Path] = []
        records: list[Path] = []
        for tag, step in sorted(job.tags.items(), key=lambda item: item[1].index):
            logs += files.get(tag, [])
            if step.kind == "record":
                records += files.get(tag, [])
        return FlightResult(
            tuple(logs),
            tuple(records),
            *job.flown,
            self._shared.lost - job.counts_before[1],
            control_words[Word.PLAN_CUT] >= job.number,
            job.verdict.unjudged,
            job.verdict.skipped,
        )


def in_fault(control_words: ControlWords) -> str:
    """Return the reason to refuse a flight while in a fault."""
    detail = f" ({control_words.detail})" if control_words.detail else ""
    clear = "clear it first: remove its cause, then run `levid clear`"
    return f"in fault {control_words.fault.name}{detail}: {clear}"
