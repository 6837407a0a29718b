"""What clients may ask, and how it is answered; the supervisor parses short requests alone."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Callable, Generator, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..api.control_server import LONGEST_SHORT, Handler, Reply
from ..control.faults import Fault
from ..control.states import State
from ..ipc.control_words import Word
from ..planning.plan_file import PlannedRequest
from ..planning.planner import RefusedError, Situation
from ..planning.planner_process import Work
from ..recording.log_router import LogFile
from ..recording.session_logs import log_metadata
from .job_runner import Job, in_fault

if TYPE_CHECKING:
    from .supervisor import Supervisor

_READY_S = 60.0
_TELL_S = 5.0
_PLANNING_S = 600.0
"""How long planning may take on a machine that is busy with other things: its processor time is
limited where it is planned."""
_FOLDER_S = 60.0
"""How long making a folder may take: one on a mount that is dead is never there."""
_RECORDER_S = 120.0
"""How long a flight waits for the recorder: on a machine that starves it, it takes its time."""
_LEAST_WATCH_S, _MOST_WATCHERS = 0.05, 32

Request = Mapping[str, Any]
Moment = tuple[int, int, int]
"""How often a landing was asked for, a fault was to be cleared, and the loop was started."""


@dataclass
class _Turn:
    """From a request to the end of its flight nobody else has a turn.

    `progress` yields what it waits for, until its flight begins; `now` is what it waits for.
    """

    line: bytes
    reply: Reply
    asked: Moment
    progress: Generator[str, None, None] | None = None
    now: str = ""
    told_s: float = 0.0
    flying: bool = False


class Requests:
    """Handlers for the server: each returns at once; what takes time goes on in `tick`."""

    def __init__(self, supervisor: Supervisor) -> None:
        self._supervisor = supervisor
        self._guard = threading.Lock()  # of whose turn it is, for moments
        self._turn: _Turn | None = None
        self.watchers: list[Watcher] = []

    @property
    def handlers(self) -> Mapping[str, Handler]:
        """Handlers by the request's `op`."""
        return {
            "status": lambda _, reply: reply.done(**self._supervisor.status()),
            "stop": self._stop,
            "land": self._land,
            "clear": self._clear,
            "watch": self._watch,
            **dict.fromkeys(("excite", "levitate", "move"), self._plan),
        }

    def long(self, line: bytes, reply: Reply) -> None:
        """Take a request that is too long to be parsed here: the planner does."""
        try:
            self._begin_turn(line, reply)
        except RefusedError as error:
            raise RefusedError(
                f"{error} (a request of more than {LONGEST_SHORT} bytes is one to plan)"
            ) from None

    def tick(self, now_s: float, status: Callable[[], dict[str, Any]]) -> None:
        """In the supervisor's thread: send watchers what is due, bring on the request at hand."""
        self.watchers[:] = [w for w in self.watchers if w.tick(now_s, status)]
        turn = self._turn
        if turn is None or turn.flying:
            return
        try:
            if turn.progress is None:
                turn.progress = self._progress(turn)
            self._check(turn)
            now = next(turn.progress)
        except StopIteration:  # its flight began, and ends its turn
            turn.flying = True
            return
        except Exception as error:  # noqa: BLE001 - the client is told, the daemon goes on
            if turn.progress is not None:
                turn.progress.close()
            self._over(turn)
            turn.reply.refuse(str(error) or type(error).__name__)
            return
        if now != turn.now:
            turn.now, turn.told_s = now, now_s
        elif now_s - turn.told_s > _TELL_S:
            turn.told_s = now_s
            turn.reply.send({"step": now, "share": 0.0})

    def _stop(self, _: Request, reply: Reply) -> None:
        # The word is set before anything else happens: it needs none of the rest of the daemon.
        self._supervisor.board.stop()
        reply.done(stopping=True)

    def _clear(self, _: Request, reply: Reply) -> None:
        # In the thread that answers `stop`: a stop that comes after this is one of its own.
        supervisor = self._supervisor
        stops = supervisor.board[Word.STOPS]
        supervisor.post(lambda: supervisor.clear(reply, stops))

    def _land(self, _: Request, reply: Reply) -> None:
        pilot = self._supervisor.pilot
        # Asked for while a flight is planned it means that flight; where there is none, nothing.
        self._supervisor.board.land()
        reply.done(landing=pilot.job is not None or pilot.airborne)

    def _watch(self, request: Request, reply: Reply) -> None:
        every_s = request.get("every_s", 0.5)
        if not isinstance(every_s, (int, float)) or not every_s >= _LEAST_WATCH_S:
            raise RefusedError(f"watch: expected every_s of {_LEAST_WATCH_S} or more")
        if len(self.watchers) >= _MOST_WATCHERS:
            raise RefusedError(f"watch: expected at most {_MOST_WATCHERS} watchers")
        watcher = Watcher(reply, float(every_s))
        self._supervisor.post(lambda: self.watchers.append(watcher))

    def _plan(self, request: Request, reply: Reply) -> None:
        self._begin_turn(json.dumps(request).encode(), reply)

    def _begin_turn(self, line: bytes, reply: Reply) -> None:
        board = self._supervisor.board
        if board.fault is not Fault.NONE:
            raise RefusedError(in_fault(board))
        # One at a time, from its planning to its end: a plan begins where the manipulator is.
        turn = _Turn(line, reply, self._moment)
        with self._guard:
            if self._turn is not None:
                raise RefusedError("a session is being flown, or is about to be")
            self._turn = turn

    def _over(self, turn: _Turn) -> None:
        """Let the next one come, unless that has been done."""
        with self._guard:
            if self._turn is turn:
                self._turn = None

    @property
    def _moment(self) -> Moment:
        board = self._supervisor.board
        # Who asks before the first loop is there waits for it.
        return board[Word.LAND], board[Word.CLEAR], max(board[Word.LOOPS], 1)

    def _progress(self, turn: _Turn) -> Generator[str, None, None]:
        """Bring a request on to the beginning of its flight; yields what it waits for.

        Raises what it is refused for.
        """
        supervisor, board = self._supervisor, self._supervisor.board
        yield from self._idle()
        situation = Situation(
            board.state, *supervisor.manipulator, supervisor.pilot.coils_are_known
        )
        planned = yield from self._work(Work.PLAN, turn.line, situation, _PLANNING_S)
        assert isinstance(planned, PlannedRequest)
        if planned.note:
            supervisor.tell(planned.note)
        files: dict[int, LogFile] = {}
        if planned.out:
            yield from self._work(Work.FOLDER, planned.out.encode(), situation, _FOLDER_S)
            files = self._files(planned)
            yield from self._recorder()
        supervisor.pilot.begin(self._job(turn, planned, files))
        if turn.asked != self._moment:  # between the look and the announcement
            board.land()

    def _check(self, turn: _Turn) -> None:
        """Call off what nobody waits for, or wants, any more; raises RefusedError."""
        if not turn.reply.waiting:
            raise RefusedError("the client is gone")
        if turn.asked != self._moment:
            raise RefusedError("landed, stopped or cleared since it was asked for")
        if self._supervisor.stopping:
            raise RefusedError("the daemon is ending")

    def _idle(self) -> Iterator[str]:
        """Wait for the self-test."""
        board, begin_s = self._supervisor.board, time.monotonic()
        while board.state in (State.OFF, State.SELF_TEST):
            if time.monotonic() - begin_s > _READY_S:
                raise RefusedError(f"the loop was not ready within {_READY_S:g} s")
            yield "self-test"

    def _work(
        self, work: Work, data: bytes, situation: Situation, seconds: float
    ) -> Generator[str, None, PlannedRequest | bool]:
        """Have the planner do something; return what comes of it."""
        planner = self._supervisor.planner
        planner.ask(work, data, situation)
        begin_s = time.monotonic()
        try:
            while (answer := planner.answer()) is None:
                if time.monotonic() - begin_s > seconds:
                    planner.give_up()
                    raise RefusedError(
                        f"planning took longer than {seconds:g} s and is given up: expected a "
                        "session that this machine can plan, and an 'out' that answers (a mount "
                        "may be dead)"
                    )
                yield "planning"
        finally:
            planner.forget()
        return answer

    def _recorder(self) -> Iterator[str]:
        """Wait until the recorder lives and has taken all rows: else the flight leaves no log."""
        recorder = self._supervisor.recorder
        recorder.ask_ready()
        begin_s = time.monotonic()
        while not recorder.is_ready:
            if time.monotonic() - begin_s > _RECORDER_S:
                raise RefusedError(
                    f"the recorder was not ready within {_RECORDER_S:g} s"
                    f"{f' ({recorder.problem})' if recorder.problem else ''}: a flight that is to "
                    "be logged does not lift off without it"
                )
            yield "recorder"

    def _files(self, planned: PlannedRequest) -> dict[int, LogFile]:
        """Return the log of each step by its index: of a session one each, by hand one in all."""
        texts = {**self._supervisor.attachments, "session.yaml": planned.session}
        plan, folder = planned.plan, Path(planned.out)
        if planned.op == "excite":
            return {
                step.index: LogFile(
                    folder / f"{step.index:02d}-{step.name}.mcap", log_metadata(plan, step), texts
                )
                for step in plan.steps
            }
        metadata = {**log_metadata(plan, plan.steps[0]), "kind": "flight", "name": "flight"}
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
    """A client that is sent the status, again and again, until it hangs up."""

    def __init__(self, reply: Reply, every_s: float) -> None:
        self._reply, self._every_s, self._told_s = reply, every_s, 0.0

    def tick(self, now_s: float, status: Callable[[], Mapping[str, Any]]) -> bool:
        """Send the status if it is time; return whether anybody watches."""
        if now_s - self._told_s >= self._every_s:
            self._told_s = now_s
            self._reply.send(status())
        return self._reply.waiting
