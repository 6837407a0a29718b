"""What clients may ask, and how it is answered; planning has a thread of its own."""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..config.base import ConfigError, parse, parse_text
from ..config.rig import RigConfig
from ..config.session import CoilCheck, Land, Levitate, Move, SessionConfig, Step
from .board import Word
from .faults import Fault
from .pilot import Job, RefusedError, in_fault
from .plan import MOST_CYCLES, Plan, PlannedStep, plan_session, plan_steps
from .result import attachments, log_metadata
from .scribe import LogFile
from .server import Handler, Reply
from .states import State

if TYPE_CHECKING:
    from .supervisor import Supervisor

_POLL_S = 0.02
_READY_S = 60.0
_TELL_S = 5.0
_PLANNING_S = 600.0
"""How long planning may take: many times what the longest session does. What never comes to an end
is a folder on a mount that is dead."""
_LEAST_WATCH_S, _MOST_WATCHERS = 0.05, 32

Request = Mapping[str, Any]
Planner = Callable[[Request, Reply], Job]
Moment = tuple[int, int, int]
"""How often a landing was asked for, a fault was to be cleared, and the loop was started."""


@dataclass
class _Turn:
    """From a request's planning to the end of its flight nobody else has a turn."""

    reply: Reply
    since_s: float | None = None  # it is being planned
    told_s: float = 0.0


class Requests:
    """Handlers for the server: each returns at once; what takes time goes on in another thread."""

    def __init__(self, supervisor: Supervisor) -> None:
        self._supervisor = supervisor
        self._guard = threading.Lock()  # of whose turn it is, for moments
        self._turn: _Turn | None = None
        self._plans: queue.Queue[tuple[Planner, Request, _Turn, Moment]]
        self._plans = queue.Queue(maxsize=1)
        self.watchers: list[Watcher] = []

    @property
    def _rig(self) -> RigConfig:
        return self._supervisor.rig

    @property
    def handlers(self) -> Mapping[str, Handler]:
        """Handlers by the request's `op`."""
        return {
            "status": lambda _, reply: reply.done(**self._supervisor.status()),
            "stop": self._stop,
            "land": self._land,
            "clear": self._clear,
            "excite": lambda request, reply: self._plan(self._session, request, reply),
            "levitate": lambda request, reply: self._plan(self._lift_off, request, reply),
            "move": lambda request, reply: self._plan(self._move, request, reply),
            "watch": self._watch,
        }

    def start(self) -> None:
        """Plan what is asked for from now on."""
        threading.Thread(target=self._run, name="levid-planner", daemon=True).start()

    def tick(self, now_s: float, status: Callable[[], dict[str, Any]]) -> None:
        """Tell watchers what is due, and whoever waits for a plan that it takes its time."""
        self.watchers[:] = [w for w in self.watchers if w.tick(now_s, status)]
        turn = self._turn
        since_s = turn.since_s if turn is not None else None
        if turn is None or since_s is None:
            return
        if now_s - since_s > _PLANNING_S:
            self._give_up(turn)
        elif now_s - turn.told_s > _TELL_S:
            turn.told_s = now_s
            turn.reply.send({"step": "planning", "share": 0.0})

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

    def _plan(
        self, planner: Callable[[Request, Reply], Job], request: Request, reply: Reply
    ) -> None:
        board = self._supervisor.board
        if board.fault is not Fault.NONE:
            raise RefusedError(in_fault(board))
        # One at a time, from its planning to its end: a plan begins where the manipulator is.
        turn = _Turn(reply)
        with self._guard:
            if self._turn is not None:
                raise RefusedError("a session is being flown, or is about to be")
            self._turn = turn
        self._plans.put_nowait((planner, request, turn, self._moment))

    def _over(self, turn: _Turn | None) -> None:
        """Let the next one come, unless that has been done."""
        with self._guard:
            if self._turn is turn:
                self._turn = None

    def _give_up(self, turn: _Turn) -> None:
        """Leave a planning that does not end to itself; another thread plans what comes next."""
        with self._guard:
            if self._turn is not turn or turn.since_s is None:
                return  # it came to its end meanwhile
            self._turn = None
        self.start()
        turn.reply.refuse(
            f"planning took longer than {_PLANNING_S:g} s and is given up: expected a session that "
            "this machine can plan, and an 'out' that answers (a mount may be dead)"
        )

    @property
    def _moment(self) -> Moment:
        board = self._supervisor.board
        return board[Word.LAND], board[Word.CLEAR], board[Word.LOOPS]

    def _run(self) -> None:
        while True:
            planner, request, turn, asked = self._plans.get()
            job, why = None, ""
            try:
                self._wait_until_ready(turn.reply)
                turn.since_s = turn.told_s = time.monotonic()
                job = planner(request, turn.reply)
            except Exception as error:  # noqa: BLE001 - the client is told, the daemon goes on
                why = str(error) or type(error).__name__
            with self._guard:
                turn.since_s = None
                if self._turn is not turn:
                    return  # it was given up, and this thread has a successor
            if job is None:
                self._over(turn)
                turn.reply.refuse(why)
            else:
                self._supervisor.post(partial(self._begin, job, asked))

    def _begin(self, job: Job, asked: Moment) -> None:
        """In the supervisor's thread. Nothing lifts off that nobody waits for any more."""
        try:
            if not job.reply.waiting:
                raise RefusedError("the client is gone")
            if asked != self._moment:
                raise RefusedError("landed, stopped or cleared since it was asked for")
            if self._supervisor.stopping:
                raise RefusedError("the daemon is ending")
            self._supervisor.pilot.begin(job)
            if asked != self._moment:  # between the look and the announcement
                self._supervisor.board.land()
        except Exception as error:  # noqa: BLE001 - as above
            job.over()
            job.reply.refuse(str(error) or type(error).__name__)

    def _wait_until_ready(self, reply: Reply) -> None:
        """Wait for the self-test, and tell the client now and then that it has to."""
        begin_s = told_s = time.monotonic()
        while self._supervisor.board.state in (State.OFF, State.SELF_TEST):
            now_s = time.monotonic()
            if now_s - begin_s > _READY_S:
                raise RefusedError(f"the loop was not ready within {_READY_S:g} s")
            if now_s - told_s > _TELL_S:
                told_s = now_s
                reply.send({"step": "self-test", "share": 0.0})
            time.sleep(_POLL_S)

    def _require_rest(self, op: str) -> None:
        """Refuse before the work of planning what cannot be flown."""
        state = self._supervisor.board.state
        if state is not State.IDLE:
            raise RefusedError(f"{op}: expected the state IDLE, found {state.name}")

    def _session(self, request: Request, reply: Reply) -> Job:
        text, out = request.get("session"), request.get("out")
        if not isinstance(text, str) or not isinstance(out, str):
            raise RefusedError("excite: expected 'session' (YAML text) and 'out' (a folder)")
        self._require_rest("excite")
        self._check_rig(request.get("rig"))
        session = parse_text(text, SessionConfig, "session")
        if session.rate_hz not in (None, self._rig.rate_hz):
            raise ConfigError(
                f"session {session.name}: rate_hz: expected the daemon's {self._rig.rate_hz:g} Hz, "
                f"found {session.rate_hz:g} Hz"
            )
        self._require_length(session.name, _least_cycles(session, self._rig.rate_hz))
        check = self._due_check(session.steps[0].levitate)
        plan = plan_session(session, self._rig, *self._supervisor.manipulator, check=check)
        folder = _folder(out)
        texts = attachments(self._supervisor.rig_text, text.encode())
        files = {
            step.index: LogFile(
                folder / f"{step.index:02d}-{step.name}.mcap", log_metadata(plan, step), texts
            )
            for step in plan.steps
        }
        land = session.steps[-1].land or Land()
        return self._job(plan, files, reply, land, request)

    def _lift_off(self, request: Request, reply: Reply) -> Job:
        self._require_rest("levitate")
        levitate = parse(request.get("levitate") or {}, Levitate, "levitate")
        land = parse(request.get("land") or {}, Land, "land")
        plan = self._by_hand(Step(levitate=levitate), self._due_check(levitate))
        files: dict[int, LogFile] = {}
        out = request.get("out")
        if out is not None:
            metadata = {**log_metadata(plan, plan.steps[0]), "kind": "flight", "name": "flight"}
            texts = attachments(self._supervisor.rig_text, b"")
            files[0] = LogFile(_folder(str(out)) / "flight.mcap", metadata, texts)
        job = self._job(plan, files, reply, land, request)
        job.holds = True
        return job

    def _move(self, request: Request, reply: Reply) -> Job:
        move = parse(request.get("move") or {}, Move, "move")
        board = self._supervisor.board
        if board.state is not State.LEVITATING:
            raise RefusedError(
                f"move: expected a platform that levitates (levid levitate), "
                f"found {board.state.name}"
            )
        plan = self._by_hand(Step(move=move))
        job = self._job(plan, {}, reply, None, request)
        job.holds, job.begins_at_rest = True, False
        return job

    def _by_hand(self, step: Step, check: CoilCheck | None = None) -> Plan:
        return plan_steps([step], step.kind, self._rig, *self._supervisor.manipulator, check)

    def _due_check(self, levitate: Levitate | None) -> CoilCheck | None:
        """Return how a lift-off that does not say so itself is to check the coils, None if not.

        Nobody asked for it: a rig on which it cannot be done flies without, and is told so.
        """
        if levitate is None or levitate.check_coils is not None:
            return None
        if self._supervisor.pilot.coils_are_known:
            return None
        check = CoilCheck()
        try:
            self._by_hand(Step(levitate=levitate), check)
        except ConfigError as error:
            self._supervisor.tell(f"the coils are not checked after lift-off: {error}")
            return None
        return check

    def _job(
        self,
        plan: Plan,
        files: dict[int, LogFile],
        reply: Reply,
        land: Land | None,
        request: Request,
    ) -> Job:
        """Compute all segments: what that takes is no business of a flight."""
        gone = request.get("client_gone") or self._rig.service.client_gone
        if gone not in ("go_on", "land"):
            raise RefusedError(f"client_gone: expected go_on or land, found {gone!r}")
        rate_hz = self._rig.rate_hz
        self._require_length(plan.name, plan.cycles)
        segments: list[tuple[PlannedStep, Any]] = [(s, s.segments()) for s in plan.steps]
        landing = None
        if land is not None:
            landing = round(land.ramp_s * rate_hz), round(land.release_s * rate_hz)
        over = partial(self._over, self._turn)
        return Job(plan, segments, files, reply, over, landing, land_when_gone=gone == "land")

    def _require_length(self, name: str, cycles: int) -> None:
        rate_hz = self._rig.rate_hz
        if cycles > MOST_CYCLES:
            raise RefusedError(
                f"{name}: expected at most {MOST_CYCLES / rate_hz:g} s in all at "
                f"{rate_hz:g} Hz, found {cycles / rate_hz:g} s; fly several sessions"
            )

    def _check_rig(self, text: object) -> None:
        """Refuse a session that was written for another rig than this daemon runs."""
        if text is None:
            return
        rig = parse_text(str(text), RigConfig, "rig")
        if rig != self._rig:
            raise ConfigError(
                f"rig {rig.name}: expected the rig that this daemon runs "
                f"({self._supervisor.rig_file}), found another"
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


def _least_cycles(session: SessionConfig, rate_hz: float) -> int:
    """Return what a session's steps say of their lengths, added up; moves come on top.

    To plan a session that is far too long would take hours.
    """

    def cycles(*parts_s: float | None) -> int:
        return sum(int((part_s or 0.0) * rate_hz) for part_s in parts_s)

    found = 0
    for step in session.steps:
        if step.levitate is not None:
            found += cycles(step.levitate.unload_s, step.levitate.ramp_s, step.levitate.settle_s)
        elif step.move is not None:
            found += cycles(step.move.settle_s)
        elif step.land is not None:
            found += cycles(step.land.ramp_s, step.land.release_s)
        elif step.record is not None:
            record, inputs = step.record, len(step.record.excite)
            found += cycles(record.settle_s, record.duration_s) + inputs * cycles(record.each_s)
            if record.orthogonal is not None:
                periods = record.orthogonal.realisations * inputs * record.orthogonal.periods
                found += periods * cycles(session.excitations[record.excite[0]].period_s)
    return found


def _folder(out: str) -> Path:
    folder = Path(out)
    folder.mkdir(parents=True, exist_ok=True)
    if any(folder.glob("*.mcap")):
        raise RefusedError(f"{folder}: expected a folder without logs")
    return folder
