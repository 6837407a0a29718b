"""Whether the supervisor has been stopped (SIGSTOP, Ctrl-Z) or killed, soon after it was.

Its heartbeat is that of an ordinary process, for which a busy machine needs patience; that it is
stopped, or has to die, the kernel knows at once, while its children are told only when the last of
its threads has given its memory back. It tells parents only, which the supervisor has none of here,
and so it is asked, in /proc: by a thread beside the timed loop, which itself touches no file.
Compiled, it never holds the interpreter; it is below the loop in priority and above all that is
ordinary, and it is there as long as the loop, whatever becomes of the recorder.
"""

from __future__ import annotations

import contextlib
import os
import signal
import threading
from typing import Any

import numpy as np
from numba import njit, types
from numpy.typing import NDArray

from .board import Word
from .states import IN_FLIGHT, State

_AT_REST_S, _OFTEN_S = 2e-3, 2e-4
"""How often it looks where nothing flies, and in flight at least and at most; in between once a
period. A look costs 13 us."""
_MOST_BYTES = 512
"""Numbers of up to 20 digits."""
_JOIN_S = 1.0
_NAME_ENDS, _STATE_STOPPED = ord(")"), ord("T")
_FLAGS, _PENDING = 6, 28
"""Fields of /proc/PID/stat, counted from the state: flags of the kernel, signals that wait."""
_EXITING, _KILLED = 0x4, 1 << (signal.SIGKILL - 1)
_SPACE, _ZERO = ord(" "), ord("0")
ALIVE, STOPPED, DYING = 0, 1, 2
"""What Word.SUPERVISOR_STOPPED says."""
_pread: Any = types.ExternalFunction(
    "pread", types.intp(types.int32, types.uintp, types.uintp, types.int64)
)
_nanosleep: Any = types.ExternalFunction("nanosleep", types.int32(types.uintp, types.uintp))


class ParentWatch:
    """Writes Word.SUPERVISOR_STOPPED once a period or every 0.2 ms in flight, every 2 ms else.

    It does so while `parent` lives. `priority` is the loop's, 0 for none; where it is not
    permitted, it looks as often as it can.
    """

    def __init__(self, parent: int, words: memoryview, period_s: float, priority: int) -> None:
        self._priority = priority
        self._ended = np.zeros(1, np.int64)
        board: NDArray[np.int64] = np.frombuffer(words, np.int64)
        self._state, self._stopped = (
            board[word : word + 1] for word in (Word.STATE, Word.SUPERVISOR_STOPPED)
        )
        in_flight_s = min(max(period_s, _OFTEN_S), _AT_REST_S)
        self._sleeps = np.zeros((len(State), 2), np.int64)  # timespecs
        self._sleeps[:, 1] = [
            round(1e9 * (in_flight_s if state in IN_FLIGHT else _AT_REST_S)) for state in State
        ]
        self._watch(-1)  # compiled now, not beside the loop
        self._thread = threading.Thread(target=self._run, name="levid-parent", daemon=True)
        try:
            self._stat = os.open(f"/proc/{parent}/stat", os.O_RDONLY | os.O_CLOEXEC)
        except OSError:
            return  # dead already, which the loop sees for itself; or no /proc: it is silent later
        self._thread.start()

    def close(self) -> None:
        """Look no more."""
        self._ended[0] = 1
        if self._thread.ident is not None:
            self._thread.join(_JOIN_S)

    def _run(self) -> None:
        # Signals are the loop's: what is blocked in a driver is to be woken by them.
        signal.pthread_sigmask(signal.SIG_BLOCK, signal.valid_signals())
        if self._priority:
            below = os.sched_param(max(self._priority - 1, 1))
            with contextlib.suppress(OSError):
                os.sched_setscheduler(0, os.SCHED_FIFO, below)  # of this thread
        try:
            self._watch(self._stat)
        finally:
            os.close(self._stat)

    def _watch(self, stat: int) -> None:
        watch(stat, self._state, self._stopped, self._sleeps, self._ended)


@njit(cache=True)
def condition(stat) -> int:  # type: ignore[no-untyped-def]
    """Return ALIVE, STOPPED or DYING, by how /proc/PID/stat begins (proc(5)).

    The state follows the name, which stands in brackets and may hold brackets itself. Who is traced
    ("t") goes on in a moment, or is missed as one that hangs. Who is to die has SIGKILL waiting for
    it, until it runs, and the flag of one that exits from then on.
    """
    at = len(stat) - 3
    while at >= 0 and stat[at] != _NAME_ENDS:
        at -= 1
    if at < 0:
        return ALIVE
    if stat[at + 2] == _STATE_STOPPED:
        return STOPPED
    field, number = 0, 0
    for k in range(at + 2, len(stat)):
        if stat[k] != _SPACE:
            number = 10 * number + (stat[k] - _ZERO)
            continue
        if (field == _FLAGS and number & _EXITING) or (field == _PENDING and number & _KILLED):
            return DYING
        if field == _PENDING:
            break
        field, number = field + 1, 0
    return ALIVE


# What is compiled is kept until this file changes: what others define comes as an argument.
@njit(cache=True, nogil=True)
def watch(descriptor, state, stopped, sleeps, ended) -> None:  # type: ignore[no-untyped-def]
    """Write into `stopped` the condition of a process, until it is gone or `ended` is set.

    In between it sleeps as long as `sleeps` (states, 2), s and ns, says of the `state` at hand.
    """
    stat = np.zeros(_MOST_BYTES, np.uint8)
    while not ended[0]:
        found = _pread(descriptor, stat.ctypes.data, _MOST_BYTES, 0)
        if found <= 0:  # it is dead, which the loop sees for itself
            break
        stopped[0] = condition(stat[:found])
        _nanosleep(sleeps[state[0]].ctypes.data, 0)
    stopped[0] = 0
