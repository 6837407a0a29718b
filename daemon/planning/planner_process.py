"""The planner's process: plans each request in a confined child.

The process itself parses nothing that a client sent: it forks a child for each request, which ends
with its answer. Supervisor and planner exchange messages of fixed size, and memory files for what
is long.
"""

from __future__ import annotations

import gc
import os
import select
import signal
import socket
import struct
import sys
import traceback
from collections.abc import Sequence
from enum import IntEnum
from pathlib import Path
from typing import NamedTuple

from ...config.rig import RigConfig
from ..control.states import State
from ..host.process_limits import Confinement, confine, share_of_memory
from ..host.real_time_scheduling import call_me, die_with
from .plan import MOST_CYCLES
from .plan_file import memory_file, write_plan, write_refusal
from .planner import Planner, RefusedError, Situation

PLANNED, REFUSED = 0, 3
"""Exit codes of a child; the result file has the plan, or why there is none."""
CPU_S = 60
"""Processor time of one request: several times what the longest session takes."""
_COLUMNS = 24
"""Numbers a cycle that planning holds at a time, with those that lie in the result already."""
_FOLDER_CPU_S, _FOLDER_BYTES = 10, 1 << 28
_MOST_REQUEST = 1 << 21


class Work(IntEnum):
    """What a child does."""

    NOTHING = 0  # and what is being done is wanted no more; no files go with it
    PLAN = 1
    FOLDER = 2  # makes the folder for logs, and looks whether it has none


class Question(NamedTuple):
    """From the supervisor: what to do, and what a plan begins from; two files go with it.

    The first file is the request, a line of JSON or the path of a folder; the second is for the
    result.
    """

    job: int
    work: int
    state: int = 0
    coils_known: int = 0
    beam_m: float = 0.0
    rotor_rad: float = 0.0


class Ended(NamedTuple):
    """From the planner: how a child ended, its exit code or the signal that killed it."""

    job: int
    code: int
    signal: int


QUESTION, ENDED = struct.Struct("<4q2d"), struct.Struct("<3q")


class PlannerProcess:
    """Does one thing at a time, in the order asked."""

    def __init__(self, planner: Planner, end: socket.socket) -> None:
        self._planner, self._end = planner, end

    def run(self) -> None:
        """Serve until the supervisor hangs up."""
        while True:
            data, fds, _, _ = socket.recv_fds(self._end, QUESTION.size, 2)
            if len(data) != QUESTION.size:
                return
            question = Question(*QUESTION.unpack(data))
            if question.work == Work.NOTHING:
                continue
            try:
                code, number = self._in_child(question, fds)
            finally:
                for fd in fds:
                    os.close(fd)
            self._end.send(ENDED.pack(question.job, code, number))

    def _in_child(self, question: Question, fds: Sequence[int]) -> tuple[int, int]:
        """Return exit code and signal of the child that did it."""
        server = os.getpid()
        pid = os.fork()
        if not pid:
            code = 1
            try:
                code = self._work(question, fds, server)
            except BaseException:  # noqa: BLE001 - the journal has it, and nothing else runs here
                traceback.print_exc()
            finally:
                os._exit(code)
        ended, poll = os.pidfd_open(pid), select.poll()
        try:
            poll.register(ended, select.POLLIN)
            poll.register(self._end, select.POLLIN)
            if ended not in dict(poll.poll()):  # the next question, or the end of all
                os.kill(pid, signal.SIGKILL)
        finally:
            os.close(ended)
        _, status = os.waitpid(pid, 0)
        if os.WIFSIGNALED(status):
            return 0, os.WTERMSIG(status)
        return os.WEXITSTATUS(status), 0

    def _work(self, question: Question, fds: Sequence[int], server: int) -> int:
        """In the child: confine it, do it, leave the result in its file; return the exit code."""
        request, result = fds
        planning = question.work == Work.PLAN
        confine(_PLANNING if planning else _FOLDER, fds)
        # After the user has changed, which undoes it.
        die_with(server, signal.SIGKILL)
        try:
            data = os.pread(request, _MOST_REQUEST, 0)
            if planning:
                write_plan(result, self._planner.plan(data, _situation(question)))
            else:
                make_folder(Path(os.fsdecode(data)))
        except MemoryError:
            write_refusal(result, "planning needs more memory than it may have: fly less at once")
            return REFUSED
        except Exception as error:  # noqa: BLE001 - the client is told, whatever it is
            write_refusal(result, str(error) or type(error).__name__)
            return REFUSED
        return PLANNED


def make_folder(folder: Path) -> None:
    """Make the folder for the logs of a flight.

    Raises:
        RefusedError: it cannot be made, holds logs, or cannot be written to.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise RefusedError(f"{folder}: cannot be made: {error.strerror}") from None
    if any(folder.glob("*.mcap")):
        raise RefusedError(f"{folder}: expected a folder without logs")
    if not os.access(folder, os.W_OK | os.X_OK):
        raise RefusedError(f"{folder}: expected a folder that the daemon may write to")


def warm_up(planner: Planner) -> None:
    """Plan once what can be planned: a child that is nobody may not read what is imported late."""
    rest = Situation(State.IDLE)
    session = (
        b"levid: session\nname: warm-up\nexcitations:\n"
        b"  a: {input: z, rms_n: 1.0e-3, band_hz: [1, 5]}\n"
        b"  b: {input: psi, rms_n_m: 1.0e-3, signal: multisine, period_s: 1.0, band_hz: [1, 5]}\n"
        b"steps:\n- levitate: {}\n- record: {name: a, duration_s: 2, excite: [a, b]}\n"
        b"- record: {name: b, excite: [b], orthogonal: {realisations: 1, periods: 3}}\n"
        b"- land: {}\n"
    )
    wrong = session.replace(b"name: warm-up", b"nam: [warm-up")
    for text in (session, wrong, wrong.replace(b"[", b"")):
        request = b'{"op": "excite", "out": "x", "session": %s}' % _quoted(text)
        fd = memory_file("levid-warm-up")
        try:
            write_plan(fd, planner.plan(request, rest))
        except Exception as error:  # noqa: BLE001 - a rig may be unable to fly this
            write_refusal(fd, str(error))
        finally:
            os.close(fd)


def _situation(question: Question) -> Situation:
    return Situation(
        State(question.state), question.beam_m, question.rotor_rad, bool(question.coils_known)
    )


def _quoted(text: bytes) -> bytes:
    return b'"%s"' % text.replace(b"\n", b"\\n")


_MOST_BYTES = 8 * _COLUMNS * MOST_CYCLES
_PLANNING = Confinement(CPU_S, share_of_memory(_MOST_BYTES), share_of_memory(_MOST_BYTES))
_FOLDER = Confinement(_FOLDER_CPU_S, _FOLDER_BYTES, _FOLDER_BYTES, keeps_user=True)


def main(end: str, parent: str) -> None:
    """Plan until the supervisor hangs up; the rig comes as JSON on standard input."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    call_me("levid-planner")
    die_with(int(parent), signal.SIGKILL)
    planner = Planner(RigConfig.model_validate_json(sys.stdin.buffer.read()))
    warm_up(planner)
    gc.collect()
    gc.freeze()  # children share these pages as long as nobody writes to them
    PlannerProcess(planner, socket.socket(fileno=int(end))).run()


if __name__ == "__main__":
    main(*sys.argv[1:])
