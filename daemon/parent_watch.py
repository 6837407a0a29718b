"""Whether the supervisor has been stopped (SIGSTOP, Ctrl-Z), soon after it was.

Its heartbeat is that of an ordinary process, for which a busy machine needs patience; that it is
stopped the kernel knows at once. It tells parents only, which the supervisor has none of here, and
so it is asked: by the recorder, which has the time, and whose word reaches the loop over the board.
"""

from __future__ import annotations

import os
import threading
import time

from .board import Word

_LOOK_S = 0.002
_MOST_BYTES = 1024


class ParentWatch:
    """Writes Word.SUPERVISOR_STOPPED every 2 ms, in a thread of its own, while `parent` lives."""

    def __init__(self, parent: int, words: memoryview) -> None:
        self._words = words
        words[Word.SUPERVISOR_STOPPED] = 0
        try:
            self._stat = os.open(f"/proc/{parent}/stat", os.O_RDONLY | os.O_CLOEXEC)
        except OSError:
            return  # dead already, which the loop sees for itself; or no /proc: it is silent later
        threading.Thread(target=self._run, name="levid-parent", daemon=True).start()

    def _run(self) -> None:
        words, stat = self._words, self._stat
        try:
            while True:
                words[Word.SUPERVISOR_STOPPED] = is_stopped(os.pread(stat, _MOST_BYTES, 0))
                time.sleep(_LOOK_S)
        except OSError:  # it is gone
            words[Word.SUPERVISOR_STOPPED] = 0
        finally:
            os.close(stat)


def is_stopped(stat: bytes) -> bool:
    """Return whether a process is stopped by a signal, by what /proc/PID/stat says (proc(5)).

    Its state follows its name, which stands in brackets and may hold brackets itself. Who is
    traced ("t") goes on in a moment, or is missed as one that hangs.
    """
    return stat[stat.rfind(b")") + 2 :].startswith(b"T")
