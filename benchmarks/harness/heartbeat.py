"""How long a daemon's supervisor gave no sign of life, as somebody else sees it.

A process of its own maps the daemon's shared memory and looks at the heartbeat every half a
millisecond, with real-time priority where it may have it.
"""

from __future__ import annotations

import multiprocessing as mp
import time
from multiprocessing.connection import Connection
from pathlib import Path

from levid.benchmarks.harness.flown_rows import memory_of
from levid.benchmarks.harness.real_time import WITNESS, hurry
from levid.config.rig import load_rig
from levid.daemon.ipc.control_words import Word
from levid.daemon.ipc.shared_memory import Shared

_LOOK_S = 5e-4


class Heartbeat:
    """Watches a daemon until `close`; `longest_s` since it was last asked.

    `own_s`: the longest that the witness itself was away in that time: a gap of that length is the
    machine's.
    """

    def __init__(self, rig_file: Path, supervisor: int) -> None:
        ours, theirs = mp.Pipe()
        self._end = ours
        self._process = mp.get_context("spawn").Process(
            target=_watch, args=(theirs, rig_file, supervisor), daemon=True
        )
        self._process.start()
        theirs.close()
        self._end.recv()

    def take(self) -> tuple[float, float]:
        """Return the longest gap and the witness's own in s, and begin anew."""
        self._end.send(True)
        longest_s, own_s = self._end.recv()
        return longest_s, own_s

    def close(self) -> None:
        """Watch no more."""
        self._end.close()
        self._process.join(5.0)


def _watch(end: Connection, rig_file: Path, supervisor: int) -> None:
    board = Shared(load_rig(rig_file), memory_of(supervisor)).board
    hurry(WITNESS)
    end.send(True)
    beat, beat_s = board[Word.BEAT], time.monotonic()
    looked_s, longest_s, own_s = beat_s, 0.0, 0.0
    while True:
        time.sleep(_LOOK_S)
        now_s = time.monotonic()
        own_s, looked_s = max(own_s, now_s - looked_s), now_s
        if board[Word.BEAT] != beat:
            longest_s = max(longest_s, now_s - beat_s)
            beat, beat_s = board[Word.BEAT], now_s
        if end.poll():
            try:
                end.recv()
            except EOFError:
                return
            end.send((max(longest_s, now_s - beat_s), own_s))
            longest_s = own_s = 0.0
