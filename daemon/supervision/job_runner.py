"""Flies one job at a time: hands its segments to the loop, follows it, and tells how it ended."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

from ...config.rig import RigConfig
from ..api.control_server import Reply
from ..control.coil_check import Verdict, coil_check
from ..control.faults import Fault, FlightFault
from ..control.segment import Segment
from ..control.states import IN_FLIGHT, State
from ..ipc.control_words import Board, Word
from ..ipc.row_ring import NO_LOG
from ..ipc.segment_stream import Feeder, Logged
from ..ipc.shared_memory import Shared
from ..planning.plan import Plan, PlannedStep
from ..planning.planner import RefusedError
from ..recording.log_router import LogFile
from ..recording.recorder_link import RecorderLink
from ..recording.session_logs import FlightResult, RecordingError, in_doubt

_PROGRESS_S = 0.5
_MISSING_ROWS = 64
"""Rows to look back further: a cycle at rest that ends in an error harms nobody and has none."""
_WRITING_S = 60.0
"""How long the recorder may take to bring the last rows into their files."""


@dataclass
class Job:
    """A plan with its segments, and who waits for its end.

    `segments` yields those of each step; it is asked for them some seconds before they are flown.
    `files`: the log of each step by its index; a step without one goes on in the log at hand.
    `over` is called when the next job may come. `landing` (ramp, release): cycles of a landing
    before the plan's end, None for that of the flight it is part of. A job that `holds` is over
    when its plan is, in the air. `rows`: of the ring, number and count of those of which one is
    the plan's first. `flown`: cycles, and late ones, up to its end.
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
    begun: int = 0
    rows: tuple[int, int] = (0, 0)
    misses: tuple[int, int] = (0, 0)
    tags: dict[int, PlannedStep] = field(default_factory=dict)
    told_s: float = 0.0
    over_s: float | None = None
    end: int = 0
    flown: tuple[int, int] = (0, 0)
    verdict: Verdict = field(default_factory=Verdict)
    error: Exception | None = None

    def step_of(self, tag: int) -> str:
        """Return the name of the step whose log this is; without a log of the only step."""
        if tag in self.tags:
            return self.tags[tag].name
        return self.plan.steps[0].name if len(self.plan.steps) == 1 else ""


class Pilot:
    """In the supervisor's thread; `tick` never waits. `clients_gone` counts those in mid-flight."""

    def __init__(
        self,
        rig: RigConfig,
        shared: Shared,
        recorder: RecorderLink,
        say: Callable[[str], None] = lambda _: None,
    ) -> None:
        self._rig, self._recorder, self._say = rig, recorder, say
        self._shared = shared
        self._board, self._ring, self._program = shared.board, shared.ring, shared.program
        self._feeder: Feeder | None = None
        self._plans = 0
        self._flight_log = NO_LOG
        self.job: Job | None = None
        self.clients_gone = 0
        self._known_since: tuple[int, int] | None = None

    @property
    def airborne(self) -> bool:
        """Whether the coils carry the platform."""
        return self._board.state in IN_FLIGHT

    @property
    def coils_are_known(self) -> bool:
        """Whether each coil was seen to move what it should, since the start and any fault."""
        return self._known_since == self._last_repair

    @property
    def _last_repair(self) -> tuple[int, int]:
        """After a fault somebody may have had his hands on the cables."""
        return self._board[Word.CLEAR], self._board[Word.LOOPS]

    def begin(self, job: Job) -> None:
        """Fly `job` from now on; raises RefusedError."""
        board = self._board
        if self.job is not None:
            raise RefusedError("a session is being flown")
        if board.fault is not Fault.NONE:
            raise RefusedError(in_fault(board))
        wanted = State.IDLE if job.begins_at_rest else State.LEVITATING
        if board.state is not wanted or board[Word.PLAN]:
            raise RefusedError(f"expected the state {wanted.name}, found {board.state.name}")
        if job.begins_at_rest:
            self._recorder.forget()
            self._flight_log = NO_LOG
        # The last step's log now: it takes a landing, whenever that comes.
        before = self._flight_log
        tag = self._tag_of(job, job.plan.steps[-1], before)
        if job.holds:
            self._flight_log = tag
        self._plans += 1
        job.number = self._plans
        job.begun = board[Word.CYCLE]
        job.misses = board[Word.LATE], self._shared.lost
        board[Word.LAND_LOG] = tag  # the last step's: that is the landing, if there is one
        if job.landing is not None:
            board[Word.LAND_RAMP], board[Word.LAND_RELEASE] = job.landing
        self._feeder = Feeder(self._program, board, job.number, self._logged(job, before))
        if self._feeder.wrong:
            raise RefusedError(f"the plan cannot be flown: {self._feeder.wrong}")
        self.job = job
        first = self._ring.head
        self._feeder.feed()
        job.rows = first, self._ring.head + 1 - first

    def _logged(self, job: Job, tag: int) -> Iterator[Logged]:
        """Yield the segments of a job, each log made known before its first one is announced."""
        for step, segments in job.segments:
            tag = self._tag_of(job, step, tag)
            yield from (Logged(segment, tag) for segment in segments)

    def _tag_of(self, job: Job, step: PlannedStep, before: int) -> int:
        """Return the tag of a step's log, that of the one `before` where it goes on in that."""
        if step.index not in job.files:
            return before
        known = {of.index: tag for tag, of in job.tags.items()}
        if step.index not in known:
            known[step.index] = self._recorder.define(job.files[step.index])
            job.tags[known[step.index]] = step
        return known[step.index]

    def tick(self) -> None:
        """Stream, tell how far it is, and end the job when it is over."""
        job, board = self.job, self._board
        if job is None:
            return
        assert self._feeder is not None
        self._feeder.feed()
        if self._feeder.wrong and job.error is None:
            job.error = RefusedError(f"the plan cannot be flown on: {self._feeder.wrong}")
            board.land()
        self.note_fault()
        self._check_coils(job, self._feeder)
        now_s = time.monotonic()
        if job.over_s is None:
            if board[Word.PLAN_DONE] >= job.number:
                self._over(job, now_s)
            else:
                self._say_progress(job, now_s, self.step_of(job), self.share_of(job))
            if not job.reply.waiting and not job.abandoned:
                job.abandoned = True
                self._client_is_gone(job)
        elif job.holds or self._written(job) or now_s - job.over_s > _WRITING_S:
            self._recorder.hear()  # what it said before its last row was on disk
            if job.error is None and not job.holds and not self._written(job):
                why = self._recorder.problem or f"not after {_WRITING_S:g} s"
                job.error = RecordingError(f"the last rows are not on the disk: {why}")
            self.job = self._feeder = None
            job.over()
            self._tell(job)
        else:  # a client that hears nothing for long gives up
            self._say_progress(job, now_s, "writing", 1.0)

    def _client_is_gone(self, job: Job) -> None:
        self.clients_gone += 1
        what = "it is landed" if job.land_when_gone else "the flight goes on"
        self._say(f"the client that asked for '{job.plan.name}' is gone: {what}")
        if job.land_when_gone:
            self._board.land()

    def _say_progress(self, job: Job, now_s: float, step: str, share: float) -> None:
        if now_s - job.told_s >= _PROGRESS_S:
            job.told_s = now_s
            job.reply.send({"step": step, "share": share})

    def note_fault(self) -> None:
        """Keep the fault that the job at hand met: whoever asked hears of it, cleared or not."""
        job, board = self.job, self._board
        if job is None or job.error is not None or job.number != board[Word.FAULT_PLAN]:
            return
        fault = board.fault
        if fault is not Fault.NONE:
            at_s = board[Word.FAULT_CYCLE] / self._rig.rate_hz
            step = job.step_of(board[Word.FAULT_LOG])
            job.error = FlightFault(fault, at_s, step, board.detail)

    def abort(self, fault: Fault, detail: str) -> None:
        """The loop is gone: what is flown ends here."""
        job, board = self.job, self._board
        step = "" if job is None else self.step_of(job)  # by a word that goes with the loop
        board[Word.PLAN], board[Word.LOG] = 0, NO_LOG
        board[Word.PLAN_CUT] = board[Word.PLAN_DONE] = self._plans
        board[Word.QUEUE_TAIL] = board[Word.QUEUE_HEAD]
        if job is not None and job.over_s is None:
            at_s = board[Word.CYCLE] / self._rig.rate_hz
            job.error = FlightFault(fault, at_s, step, detail)
            self._over(job, time.monotonic())

    def _over(self, job: Job, now_s: float) -> None:
        """Note what was flown; what is left is to bring its last rows to the disk."""
        board = self._board
        job.over_s, job.end = now_s, self._ring.head
        job.flown = board[Word.CYCLE] - job.begun, board[Word.LATE] - job.misses[0]

    def step_of(self, job: Job) -> str:
        """Return the name of the step of a job that is flown."""
        return job.step_of(self._board[Word.LOG])

    def share_of(self, job: Job) -> float:
        """Return the share of a job that is flown, 0 to 1."""
        flown = self._board[Word.CYCLE] - job.begun
        return min(max(flown / max(job.plan.cycles, 1), 0.0), 1.0)

    def _check_coils(self, job: Job, feeder: Feeder) -> None:
        """Judge a check of coils once it is flown; meanwhile the platform settles.

        It may be the last thing that its plan does, or over for long if nobody had time to look.
        """
        board = self._board
        if feeder.check is None:
            return
        pushes, cycles, last = feeder.check
        ended, flown = board[Word.PLAN_DONE] >= job.number, board[Word.ROWS_TAIL]
        if flown < last + (not ended):
            return  # the last push's row may still be at hand, or the flight was cut before it
        feeder.check = None
        if job.error is not None or board.fault is not Fault.NONE:
            return
        # The loop wrote one row for each of the plan's, from one of these on.
        first, among = job.rows
        begin = max(first + last + 1 - cycles - feeder.base - _MISSING_ROWS, 0)
        found = self._ring.copy(begin, _MISSING_ROWS + among + cycles)
        rows = found.rows if found.first == begin else found.rows[:0]  # else it begins too late
        job.verdict = verdict = coil_check(rows, pushes, self._rig.geometry)
        if verdict.error:
            board.stop(Fault.COIL_CHECK, verdict.error)
            # The fault comes in the next cycle, in which this plan may be over already.
            at_s = board[Word.CYCLE] / self._rig.rate_hz
            job.error = FlightFault(Fault.COIL_CHECK, at_s, self.step_of(job), verdict.error)
        elif verdict.unjudged:
            self._say(in_doubt(verdict.unjudged))
        else:
            self._known_since = self._last_repair

    def _written(self, job: Job) -> bool:
        return self._ring.durable >= job.end and self._board[Word.WRITING] not in job.tags

    def _tell(self, job: Job) -> None:
        """Answer whoever waits for this job."""
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
        )

    def _result(self, job: Job) -> FlightResult:
        board, files = self._board, self._recorder.files
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
            self._shared.lost - job.misses[1],
            board[Word.PLAN_CUT] >= job.number,
            job.verdict.unjudged,
        )


def in_fault(board: Board) -> str:
    """Return why nothing can be flown in the fault at hand."""
    detail = f" ({board.detail})" if board.detail else ""
    return f"in fault {board.fault.name}{detail}: clear it first"
