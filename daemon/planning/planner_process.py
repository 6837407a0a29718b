"""Planner process: plan each request in a confined child process.

The planner itself parses no client data: it forks a child for each request, which ends after its
answer. Supervisor and planner exchange messages of fixed size, and long data in memory files.
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
from typing import TYPE_CHECKING, NamedTuple

from ...config.rig import RigConfig
from ..control.states import State
from ..host.child_process import receive_signals
from ..host.process_confinement import Confinement, at_most_half_memory, confine
from ..host.real_time_scheduling import set_process_name, signal_at_parent_death
from .log_folder import make_folder
from .plan import MOST_CYCLES
from .plan_memory_file import memory_file, write_plan, write_refusal
from .refused_request import Situation

if TYPE_CHECKING:
    from .planner import Planner

PLANNED, REFUSED = 0, 3
"""Exit codes of a child; the result file holds the plan or the reason of the refusal."""
CPU_S = 60
"""Processor time limit of one request: several times the need of the longest session."""
_COLUMNS = 24
"""Numbers per cycle that planning holds in memory, the result file included."""
_FOLDER_CPU_S, _FOLDER_BYTES = 10, 1 << 28
_MAX_REQUEST = 1 << 21


class Work(IntEnum):
    """Number the tasks of a child."""

    NOTHING = 0  # cancels the current task; sent without files
    PLAN = 1
    FOLDER = 2  # create the log folder, check that it holds no logs and its disk has room


class Question(NamedTuple):
    """Message from the supervisor: the task and the start of a plan; two files go with it.

    The first file holds the request: a line of JSON, or for a folder its path, that of
    `recording.root` (or nothing) and the room that the logs need in bytes, with zero bytes between.
    The second one takes the result.
    """

    job: int
    work: int
    state: int = 0
    coils_known: int = 0
    beam_m: float = 0.0
    rotor_rad: float = 0.0


class Ended(NamedTuple):
    """Message from the planner: the exit code of a child, or the signal that killed it."""

    job: int
    code: int
    signal: int


QUESTION, ENDED = struct.Struct("<4q2d"), struct.Struct("<3q")


class PlannerProcess:
    """Execute tasks one at a time, in the order of the messages."""

    def __init__(self, planner: Planner, end: socket.socket) -> None:
        self._planner, self._end = planner, end

    def run(self) -> None:
        """Execute tasks until the supervisor closes the connection."""
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
        """Execute a task in a child; return its exit code and signal."""
        server = os.getpid()
        pid = os.fork()
        if not pid:
            code = 1
            try:
                code = self._work(question, fds, server)
            except BaseException:  # noqa: BLE001 - the traceback goes to the journal
                traceback.print_exc()
            finally:
                os._exit(code)
        ended, poll = os.pidfd_open(pid), select.poll()
        try:
            poll.register(ended, select.POLLIN)
            poll.register(self._end, select.POLLIN)
            if ended not in dict(poll.poll()):  # a new message or the end of the supervisor
                os.kill(pid, signal.SIGKILL)
        finally:
            os.close(ended)
        _, status = os.waitpid(pid, 0)
        if os.WIFSIGNALED(status):
            return 0, os.WTERMSIG(status)
        return os.WEXITSTATUS(status), 0

    def _work(self, question: Question, fds: Sequence[int], server: int) -> int:
        """Execute a task in the confined child; write the result file, return the exit code."""
        request, result = fds
        planning = question.work == Work.PLAN
        confine(_PLANNING if planning else _FOLDER, fds)
        # After the change of the user, which resets it.
        signal_at_parent_death(server, signal.SIGKILL)
        try:
            data = os.pread(request, _MAX_REQUEST, 0)
            if planning:
                write_plan(result, self._planner.plan(data, _situation(question)))
            else:
                folder, root, needed = map(os.fsdecode, data.split(b"\0"))
                note = make_folder(Path(folder), int(needed), root, self._planner.recording)
                write_refusal(result, note)
        except MemoryError:
            write_refusal(result, "planning exceeds its memory limit: fly shorter sessions")
            return REFUSED
        except Exception as error:  # noqa: BLE001 - the client gets the error
            write_refusal(result, str(error) or type(error).__name__)
            return REFUSED
        return PLANNED


def warm_up(planner: Planner) -> None:
    """Plan one request of each kind, so that all modules are imported.

    The user `nobody` of a child may not be able to read them.
    """
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


_MAX_BYTES = 8 * _COLUMNS * MOST_CYCLES
_PLANNING = Confinement(CPU_S, at_most_half_memory(_MAX_BYTES), at_most_half_memory(_MAX_BYTES))
_FOLDER = Confinement(_FOLDER_CPU_S, _FOLDER_BYTES, _FOLDER_BYTES, keeps_user=True)


def main(end: str, parent: str) -> None:
    """Plan until the supervisor closes the connection; read the rig as JSON from standard input."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    receive_signals()
    set_process_name("levid-planner")
    signal_at_parent_death(int(parent), signal.SIGKILL)
    from .planner import Planner  # scipy, which the supervisor, an importer of this file, spares

    planner = Planner(RigConfig.model_validate_json(sys.stdin.buffer.read()))
    warm_up(planner)
    gc.collect()
    gc.freeze()  # children share these pages until they are written
    PlannerProcess(planner, socket.socket(fileno=int(end))).run()


if __name__ == "__main__":
    main(*sys.argv[1:])
