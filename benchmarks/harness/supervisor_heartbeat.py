"""Measure the longest gap between heartbeats of a daemon's supervisor, from another process.

The process maps the daemon's shared memory and reads the heartbeat every half a millisecond, with
real-time priority if permitted.
"""

from __future__ import annotations

import multiprocessing as mp
import time
from multiprocessing.connection import Connection
from pathlib import Path

from levid.benchmarks.harness.logged_vs_flown_rows import memory_of
from levid.benchmarks.harness.real_time import WITNESS, hurry
from levid.config.rig import load_rig
from levid.daemon.ipc.shared_memory import SharedMemory
from levid.daemon.ipc.shared_status_words import Word

_LOOK_S = 5e-4


class Heartbeat:
    """Watch a daemon until `close`."""

    def __init__(self, rig_file: Path, supervisor: int) -> None:
        self._end, theirs = mp.Pipe()
        context = mp.get_context("spawn")
        arguments = (theirs, rig_file, supervisor)
        self._process = context.Process(target=_watch, args=arguments, daemon=True)
        self._process.start()
        theirs.close()
        self._end.recv()

    def take(self) -> float:
        """Return the longest gap in s since the last call."""
        self._end.send(True)
        gap_s: float = self._end.recv()
        return gap_s

    def close(self) -> None:
        """Stop watching."""
        self._end.close()
        self._process.join(5.0)


def _watch(end: Connection, rig_file: Path, supervisor: int) -> None:
    control_words = SharedMemory(load_rig(rig_file), memory_of(supervisor)).control_words
    hurry(WITNESS)
    end.send(True)
    beat, beat_s, longest_s = control_words[Word.BEAT], time.monotonic(), 0.0
    while True:
        time.sleep(_LOOK_S)
        now_s = time.monotonic()
        if control_words[Word.BEAT] != beat:
            longest_s = max(longest_s, now_s - beat_s)
            beat, beat_s = control_words[Word.BEAT], now_s
        if end.poll():
            try:
                end.recv()
            except EOFError:
                return
            end.send(max(longest_s, now_s - beat_s))
            longest_s = 0.0
