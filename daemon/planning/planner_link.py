"""Pass requests from the supervisor to the planner process; monitor and restart it."""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import time
from collections.abc import Callable
from dataclasses import dataclass

from ..host.child_process import Child, module_of
from ..host.rate_limited_log import RateLimitedLog
from .plan_memory_file import PlanFileError, PlannedRequest, memory_file, read_plan, read_refusal
from .planner_process import CPU_S, ENDED, PLANNED, QUESTION, REFUSED, Ended, Question, Work
from .refused_request import RefusedError, Situation

_FIRST_PAUSE_S, _LONGEST_PAUSE_S = 0.1, 60.0
_CANCEL_S = 10.0
"""Time limit of the planner to cancel a task before it is restarted."""


@dataclass(frozen=True)
class _Task:
    job: int
    work: Work
    result: int


class PlannerLink:
    """Keep a planner running; one task at a time.

    If the planner fails, its request is refused and a new planner is started; a flight goes on.
    """

    def __init__(self, rig_json: bytes, coils: int, log: Callable[[str], None]) -> None:
        # One thread only: forking a process with several threads is unsafe.
        self._child = Child(
            "planner",
            module_of("planning.planner_process"),
            rig_json,
            {"OPENBLAS_NUM_THREADS": "1"},
        )
        self._coils, self._rarely = coils, RateLimitedLog(log)
        self._end: socket.socket | None = None
        self._jobs = 0
        self._task: _Task | None = None
        self._cancelled: tuple[int, float] | None = None  # job and time of a cancelled task
        self._pause_s, self._restart_s = _FIRST_PAUSE_S, 0.0
        self._started = False

    @property
    def pid(self) -> int | None:
        """Process id of the planner, None if it does not run."""
        return self._child.pid

    def watch(self) -> None:
        """Start the planner, or restart it if it ended or does not cancel a task."""
        now_s = time.monotonic()
        self._rarely.flush(now_s)
        if self._cancelled is not None:
            job, since_s = self._cancelled
            if self._ended(job) is not None:
                self._cancelled = None
            elif now_s - since_s > _CANCEL_S:
                self.cancel()
        # The request of a planner that ended is refused before the restart.
        if self._child.running or self._task is not None or now_s < self._restart_s:
            return
        self._cancelled = None
        if self._started:
            self._rarely.line(
                "planner", now_s, f"restarting the planner: it ended ({self._child.end})"
            )
        self._restart_s = now_s + self._pause_s
        self._pause_s = min(2 * self._pause_s, _LONGEST_PAUSE_S)
        self._started = True
        try:
            ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
            ours.setblocking(False)
            if self._end is not None:
                self._end.close()
            self._end = ours
            with theirs:
                self._child.start((theirs.fileno(), os.getpid()), (theirs.fileno(),))
        except OSError as error:
            self._rarely.line("planner", now_s, f"cannot start the planner: {error}")

    def start(self, work: Work, data: bytes, situation: Situation) -> None:
        """Start a task in the planner; raises RefusedError if it cannot take one."""
        self.discard()
        self._jobs += 1
        if self._end is None:
            raise RefusedError("the planner is starting: try again")
        question = Question(
            self._jobs,
            work,
            situation.state,
            situation.coils_known,
            situation.beam_m,
            situation.rotor_rad,
        )
        fds: list[int] = []
        try:
            fds.append(memory_file("levid-request", data))
            fds.append(memory_file("levid-plan"))
            socket.send_fds(self._end, [QUESTION.pack(*question)], fds)
        except OSError as error:
            for fd in fds:
                os.close(fd)
            self.cancel()
            raise RefusedError(f"the planner does not respond ({error}): try again") from None
        os.close(fds[0])
        self._cancelled = None
        self._task = _Task(self._jobs, work, fds[1])

    def answer(self) -> PlannedRequest | str | None:
        """Return the plan, or a journal line (or "") for a folder; None while the task runs.

        Raises:
            RefusedError: the task failed, or the planner ended.
        """
        task = self._task
        if task is None:
            raise RefusedError("the planner has no task")
        if (ended := self._ended(task.job)) is None:
            if self._child.running:
                return None
            self.discard()
            raise RefusedError(f"the planner ended ({self._child.end}): try again")
        try:
            if ended.signal == signal.SIGXCPU:
                raise RefusedError(
                    f"planning took more than {CPU_S} s of processor time: shorten the session"
                )
            if ended.signal:
                raise RefusedError(
                    f"planning was killed by {signal.Signals(ended.signal).name}: the machine may "
                    "lack memory"
                )
            if ended.code == REFUSED:
                raise RefusedError(read_refusal(task.result))
            if ended.code != PLANNED:
                raise RefusedError(f"planning failed (exit code {ended.code}); see the journal")
            self._pause_s = _FIRST_PAUSE_S
            if task.work is Work.FOLDER:
                return read_refusal(task.result)
            return read_plan(task.result, self._coils)
        except (PlanFileError, ValueError, OSError) as error:
            raise RefusedError(f"the planner wrote an invalid plan: {error}") from None
        finally:
            os.close(task.result)  # the mapping of a plan stays valid
            self._task = None

    def discard(self) -> None:
        """Discard the current task, if any: have the planner cancel it."""
        task, self._task = self._task, None
        if task is None:
            return
        os.close(task.result)
        self._cancelled = task.job, time.monotonic()
        if self._end is not None:
            with contextlib.suppress(OSError):  # the planner has ended, and the task with it
                self._end.send(QUESTION.pack(*Question(task.job, Work.NOTHING)))

    def cancel(self) -> None:
        """Kill the planner with its task; `watch` restarts it at once."""
        self.discard()
        self._child.kill(0.0)
        self._restart_s, self._cancelled = 0.0, None

    def end(self) -> None:
        """Kill the planner for good."""
        self.discard()
        self._child.kill()
        if self._end is not None:
            self._end.close()
            self._end = None

    def _ended(self, job: int) -> Ended | None:
        """Return how a job ended; None if it has not ended."""
        assert self._end is not None
        while True:
            try:
                data = self._end.recv(ENDED.size)
            except OSError:
                return None
            if len(data) != ENDED.size:
                return None
            ended = Ended(*ENDED.unpack(data))
            if ended.job == job:
                return ended
