"""Handle client requests: stop, land, clear and watch at once; flights after planning."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Callable, Generator, Iterator, Mapping
from dataclasses import dataclass
from functools import cache, partial
from typing import TYPE_CHECKING, Any

from ..api.control_server import LONGEST_SHORT, Handler, Reply
from ..control.faults import Fault
from ..control.preflight_findings import Check
from ..control.states import State
from ..ipc.shared_status_words import Word
from ..planning.plan_memory_file import PlannedRequest
from ..planning.planner_process import Work
from ..planning.refused_request import RefusedError, Situation
from ..recording.log_metadata import log_metadata
from ..recording.log_router import LogFile
from ..recording.log_size import most_log_bytes
from .flight_runner import Job, in_fault

if TYPE_CHECKING:
    from .supervisor import Supervisor

_READY_S = 60.0
_PROGRESS_S = 5.0
_PLANNING_S = 600.0
"""Time limit for planning on a busy machine; the planner limits its processor time."""
_FOLDER_S = 60.0
"""Time limit for creating the log folder: a dead mount never responds."""
_BY_HAND_S = 3600.0
"""Time of a flight by hand for whose log the disk must have room."""
_RECORDER_S = 120.0
"""Time limit to wait for the recorder before a flight; long enough for a busy machine."""
_MIN_WATCH_S, _MAX_WATCHERS = 0.05, 32

Request = Mapping[str, Any]
Moment = tuple[int, int, int]
"""Counts of requests to land, requests to clear, and loop starts."""


@dataclass
class _Turn:
    """Hold the current request, from its arrival to the end of its flight.

    `progress` yields the name of each stage before the flight; `now` is the present stage.
    """

    line: bytes
    reply: Reply
    received: Moment
    progress: Generator[str, None, None] | None = None
    now: str = ""
    reported_s: float = 0.0
    flying: bool = False


class Requests:
    """Handle requests for the server; handlers return at once, `tick` continues slow requests."""

    def __init__(self, supervisor: Supervisor) -> None:
        self._supervisor = supervisor
        self._guard = threading.Lock()  # protects `_turn`, held briefly
        self._turn: _Turn | None = None
        self.watchers: list[Watcher] = []

    @property
    def handlers(self) -> Mapping[str, Handler]:
        """Handlers by the key `op` of a request."""
        return {
            "status": lambda _, reply: reply.done(**self._supervisor.status()),
            "stop": self._stop,
            "land": self._land,
            "clear": self._clear,
            "watch": self._watch,
            **dict.fromkeys(("excite", "levitate", "move"), self._plan),
        }

    def on_long(self, line: bytes, reply: Reply) -> None:
        """Handle a request that is too long to parse here: pass it to the planner."""
        try:
            self._begin_turn(line, reply)
        except RefusedError as error:
            raise RefusedError(
                f"{error} (only excite, levitate and move may have more than {LONGEST_SHORT} bytes)"
            ) from None

    def tick(self, now_s: float, status: Callable[[], dict[str, Any]]) -> None:
        """Send status to watchers and advance the current request, in the supervisor's thread."""
        once = cache(status)  # one status for all watchers of this tick
        self.watchers[:] = [w for w in self.watchers if w.tick(now_s, once)]
        turn = self._turn
        if turn is None or turn.flying:
            return
        try:
            if turn.progress is None:
                turn.progress = self._progress(turn)
            self._check(turn)
            now = next(turn.progress)
        except StopIteration:  # the flight has started; its end ends the turn
            turn.flying = True
            return
        except Exception as error:  # noqa: BLE001 - the client gets the error; the daemon goes on
            if turn.progress is not None:
                turn.progress.close()
            self._over(turn)
            turn.reply.refuse(str(error) or type(error).__name__)
            return
        if now != turn.now:
            turn.now, turn.reported_s = now, now_s
        elif now_s - turn.reported_s > _PROGRESS_S:
            turn.reported_s = now_s
            turn.reply.send({"step": now, "share": 0.0})

    def _stop(self, _: Request, reply: Reply) -> None:
        # Directly into the control word: a stop does not depend on the supervisor's thread.
        self._supervisor.control_words.stop()
        reply.done(stopping=True)

    def _clear(self, _: Request, reply: Reply) -> None:
        # Read in the same thread as `stop`: the clear does not cancel a later stop.
        supervisor = self._supervisor
        stops = supervisor.control_words[Word.STOPS]
        supervisor.post(lambda: supervisor.clear(reply, stops))

    def _land(self, _: Request, reply: Reply) -> None:
        job_runner = self._supervisor.job_runner
        # Also cancels a flight that is being planned; without a flight it has no effect.
        self._supervisor.control_words.land()
        reply.done(landing=job_runner.job is not None or job_runner.airborne)

    def _watch(self, request: Request, reply: Reply) -> None:
        every_s = request.get("every_s", 0.5)
        if not isinstance(every_s, (int, float)) or not every_s >= _MIN_WATCH_S:
            raise RefusedError(
                f"watch: every_s: expected {_MIN_WATCH_S} s or more, found {every_s!r}"
            )
        watcher = Watcher(reply, float(every_s))
        self._supervisor.post(lambda: self._add_watcher(watcher))

    def _add_watcher(self, watcher: Watcher) -> None:
        """Add a watcher; at the limit the oldest of the lowest role gives way, or the new one."""
        self.watchers.append(watcher)
        if len(self.watchers) > _MAX_WATCHERS:
            leaves = min(self.watchers, key=lambda w: w.reply.role)
            self.watchers.remove(leaves)
            leaves.reply.refuse(
                f"watch: at most {_MAX_WATCHERS} clients may watch; this one gave way to another"
            )

    def _plan(self, request: Request, reply: Reply) -> None:
        self._begin_turn(json.dumps(request).encode(), reply)

    def _begin_turn(self, line: bytes, reply: Reply) -> None:
        control_words = self._supervisor.control_words
        if control_words.fault is not Fault.NONE:
            raise RefusedError(in_fault(control_words))
        # One at a time, planning included: a plan starts at the manipulator's present setpoints.
        turn = _Turn(line, reply, self._moment)
        with self._guard:
            if self._turn is not None:
                raise RefusedError("a session is being flown, or is about to be")
            self._turn = turn

    def _over(self, turn: _Turn) -> None:
        """End the turn of a request, so that the next one may come."""
        with self._guard:
            if self._turn is turn:
                self._turn = None

    @property
    def _moment(self) -> Moment:
        control_words = self._supervisor.control_words
        # The first start of the loop does not cancel a request that came before it.
        return (
            control_words[Word.LAND],
            control_words[Word.CLEAR],
            max(control_words[Word.LOOPS], 1),
        )

    def _progress(self, turn: _Turn) -> Generator[str, None, None]:
        """Advance a request to the start of its flight; yield the name of each stage.

        Raises RefusedError.
        """
        supervisor, control_words = self._supervisor, self._supervisor.control_words
        yield from self._idle()
        situation = Situation(
            control_words.state, *supervisor.manipulator, supervisor.job_runner.coils_are_known
        )
        planned = yield from self._work(Work.PLAN, turn.line, situation, _PLANNING_S)
        assert isinstance(planned, PlannedRequest)
        if planned.note:
            supervisor.log_soon(planned.note)
        files: dict[int, LogFile] = {}
        if planned.out:
            room = 0 if Check.DISK in planned.override else self._log_bytes(planned)
            out, root = supervisor.log_folder(planned.out), supervisor.log_root
            asked = "\0".join((str(out), str(root or ""), str(room)))
            deleted = yield from self._work(Work.FOLDER, asked.encode(), situation, _FOLDER_S)
            if deleted:
                supervisor.log_soon(str(deleted))
            files = self._files(planned)
            yield from self._recorder_ready()
        if planned.op != "move":
            for line in supervisor.preflight.require(planned.override):
                supervisor.log_soon(line)
        supervisor.job_runner.begin(self._job(turn, planned, files))
        if turn.received != self._moment:  # a request came after the last check
            control_words.land()

    def _check(self, turn: _Turn) -> None:
        """Cancel a request if its client or a later request ends it; raises RefusedError."""
        if not turn.reply.waiting:
            raise RefusedError("the client disconnected")
        if turn.received != self._moment:
            raise RefusedError("cancelled by a request to land, stop or clear")
        if self._supervisor.stopping:
            raise RefusedError("the daemon is ending")

    def _idle(self) -> Iterator[str]:
        """Wait for the end of the self-test."""
        control_words, begin_s = self._supervisor.control_words, time.monotonic()
        while control_words.state in (State.OFF, State.SELF_TEST):
            if time.monotonic() - begin_s > _READY_S:
                raise RefusedError(f"the loop was not ready within {_READY_S:g} s")
            yield "self-test"

    def _work(
        self, work: Work, data: bytes, situation: Situation, seconds: float
    ) -> Generator[str, None, PlannedRequest | str]:
        """Run a task in the planner; return its result."""
        planner = self._supervisor.planner
        planner.start(work, data, situation)
        begin_s = time.monotonic()
        try:
            while (answer := planner.answer()) is None:
                if time.monotonic() - begin_s > seconds:
                    planner.cancel()
                    raise RefusedError(
                        f"planning timed out after {seconds:g} s: shorten the session, and check "
                        "that the folder 'out' is accessible (a dead mount is not)"
                    )
                yield "planning"
        finally:
            planner.discard()
        return answer

    def _recorder_ready(self) -> Iterator[str]:
        """Wait until the recorder runs and has read all rows, so that the flight is logged."""
        recorder = self._supervisor.recorder
        recorder.request_ready()
        begin_s = time.monotonic()
        while not recorder.is_ready:
            if time.monotonic() - begin_s > _RECORDER_S:
                raise RefusedError(
                    f"the recorder was not ready within {_RECORDER_S:g} s"
                    f"{f' ({recorder.problem})' if recorder.problem else ''}: a logged flight does "
                    "not lift off without it"
                )
            yield "recorder"

    def _log_bytes(self, planned: PlannedRequest) -> int:
        """Return the most that the logs of a flight take; of a flight by hand, of an hour."""
        rig = self._supervisor.rig
        hour = round(_BY_HAND_S * rig.rate_hz)
        return most_log_bytes(rig, planned.plan.cycles if planned.op == "excite" else hour)

    def _files(self, planned: PlannedRequest) -> dict[int, LogFile]:
        """Return the log of each step by its index: one per step, or one for a flight by hand."""
        texts = {**self._supervisor.attachments, "session.yaml": planned.session}
        plan, folder = planned.plan, self._supervisor.log_folder(planned.out)
        override = {"override": ", ".join(planned.override)} if planned.override else {}
        if planned.op == "excite":
            return {
                step.index: LogFile(
                    folder / f"{step.index:02d}-{step.name}.mcap",
                    {**log_metadata(plan, step), **override},
                    texts,
                )
                for step in plan.steps
            }
        first = log_metadata(plan, plan.steps[0])
        metadata = {**first, "kind": "flight", "name": "flight", "steps": "1", **override}
        return {0: LogFile(folder / "flight.mcap", metadata, texts)}

    def _job(self, turn: _Turn, planned: PlannedRequest, files: dict[int, LogFile]) -> Job:
        gone = planned.client_gone or self._supervisor.rig.service.client_gone
        by_hand = planned.op != "excite"
        return Job(
            planned.plan,
            ((step, step.segments()) for step in planned.plan.steps),
            files,
            turn.reply,
            partial(self._over, turn),
            planned.landing,
            land_when_gone=gone == "land",
            holds=by_hand,
            begins_at_rest=planned.op != "move",
        )


class Watcher:
    """Send the status to a client periodically until it disconnects."""

    def __init__(self, reply: Reply, every_s: float) -> None:
        self.reply, self._interval_s, self._sent_s = reply, every_s, 0.0

    def tick(self, now_s: float, status: Callable[[], Mapping[str, Any]]) -> bool:
        """Send the status if the interval has passed; return whether the client is connected."""
        if now_s - self._sent_s >= self._interval_s:
            self._sent_s = now_s
            self.reply.send(status())
        return self.reply.waiting
