"""The supervisor's side of the planner: hands requests on, takes plans, starts it anew."""

from __future__ import annotations

import contextlib
import math
import os
import signal
import socket
import time
from collections.abc import Callable
from dataclasses import dataclass

from ..host.child_process import Child, module_of
from .plan_file import PlanFileError, PlannedRequest, memory_file, read_plan, read_refusal
from .planner import RefusedError, Situation
from .planner_process import CPU_S, ENDED, PLANNED, QUESTION, REFUSED, Ended, Question, Work

_FIRST_PAUSE_S, _LONGEST_PAUSE_S = 0.1, 60.0
_SAID_AGAIN_S = 60.0
_ENDS_S = 10.0
"""How long a planner may take to end what is wanted no more, before it is started anew."""


@dataclass(frozen=True)
class _Asked:
    job: int
    work: Work
    result: int


class PlannerLink:
    """Keeps a planner running; one question at a time.

    What becomes of the planner is no matter of a flight: who asked is refused, and the next one
    is started.
    """

    def __init__(self, rig_json: bytes, coils: int, say: Callable[[str], None]) -> None:
        # One thread: a process of several is not to be forked.
        self._child = Child(
            "planner",
            module_of("planning.planner_process"),
            rig_json,
            {"OPENBLAS_NUM_THREADS": "1"},
        )
        self._coils, self._say = coils, say
        self._end: socket.socket | None = None
        self._jobs = 0
        self._asked: _Asked | None = None
        self._dropped: tuple[int, float] | None = None  # a question of before, and since when
        self._pause_s, self._again_s = _FIRST_PAUSE_S, 0.0
        self._said_s = -math.inf
        self._begun = False

    @property
    def pid(self) -> int | None:
        """The planner's process."""
        return self._child.pid

    def watch(self) -> None:
        """Start the planner, or start it anew, where it is not there or does not come back."""
        now_s = time.monotonic()
        if self._dropped is not None:
            job, since_s = self._dropped
            if self._ended(job) is not None:
                self._dropped = None
            elif now_s - since_s > _ENDS_S:
                self.give_up()
        # Whoever asked the one that is gone is told first.
        if self._child.running or self._asked is not None or now_s < self._again_s:
            return
        self._dropped = None
        if self._begun:
            self._say_seldom(now_s, f"the planner is gone ({self._child.end}): it is started anew")
        self._again_s = now_s + self._pause_s
        self._pause_s = min(2 * self._pause_s, _LONGEST_PAUSE_S)
        self._begun = True
        try:
            ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
            ours.setblocking(False)
            if self._end is not None:
                self._end.close()
            self._end = ours
            with theirs:
                self._child.start((theirs.fileno(), os.getpid()), (theirs.fileno(),))
        except OSError as error:
            self._say_seldom(now_s, f"the planner cannot be started: {error}")

    def ask(self, work: Work, data: bytes, situation: Situation) -> None:
        """Hand a question on; raises RefusedError where there is no planner to take it."""
        self.forget()
        self._jobs += 1
        if self._end is None:
            raise RefusedError("the planner is being started: ask again")
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
            self.give_up()
            raise RefusedError(f"the planner does not take requests ({error}): ask again") from None
        os.close(fds[0])
        self._dropped = None
        self._asked = _Asked(self._jobs, work, fds[1])

    def answer(self) -> PlannedRequest | bool | None:
        """Return the plan, or True for a folder that is there; None while it is being worked on.

        Raises:
            RefusedError: it cannot be done, or the planner is gone; the message says why.
        """
        asked = self._asked
        if asked is None:
            raise RefusedError("the planner was not asked")
        if (ended := self._ended(asked.job)) is None:
            if self._child.running:
                return None
            self.forget()
            raise RefusedError(f"the planner is gone ({self._child.end}): ask again")
        try:
            if ended.signal == signal.SIGXCPU:
                raise RefusedError(f"planning took more than {CPU_S} s of processor time")
            if ended.signal:
                raise RefusedError(
                    f"planning was killed by {signal.Signals(ended.signal).name}: the machine may "
                    "lack memory"
                )
            if ended.code == REFUSED:
                raise RefusedError(read_refusal(asked.result))
            if ended.code != PLANNED:
                raise RefusedError(f"planning failed (exit code {ended.code}); see the journal")
            self._pause_s = _FIRST_PAUSE_S
            if asked.work is Work.FOLDER:
                return True
            return read_plan(asked.result, self._coils)
        except (PlanFileError, ValueError, OSError) as error:
            raise RefusedError(f"the planner's answer is not used: {error}") from None
        finally:
            os.close(asked.result)  # a plan keeps its memory without it
            self._asked = None

    def forget(self) -> None:
        """Expect no answer any more: what is being worked on is wanted no more."""
        asked, self._asked = self._asked, None
        if asked is None:
            return
        os.close(asked.result)
        self._dropped = asked.job, time.monotonic()
        if self._end is not None:
            with contextlib.suppress(OSError):  # it is gone, and its work with it
                self._end.send(QUESTION.pack(*Question(asked.job, Work.NOTHING)))

    def give_up(self) -> None:
        """End whatever it is working on, and start it anew."""
        self.forget()
        self._child.kill(0.0)
        self._again_s, self._dropped = 0.0, None

    def end(self) -> None:
        """End it."""
        self.forget()
        self._child.kill()
        if self._end is not None:
            self._end.close()
            self._end = None

    def _ended(self, job: int) -> Ended | None:
        """Return how a job ended; None where nothing has come of it."""
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

    def _say_seldom(self, now_s: float, what: str) -> None:
        if now_s - self._said_s >= _SAID_AGAIN_S:
            self._said_s = now_s
            self._say(what)
