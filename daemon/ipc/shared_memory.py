"""The memory that the daemon's processes share: board, ring of rows, program of segments.

It is anonymous and handed down as a file descriptor: nobody else can open it, and it is gone with
the last process that holds it, however that one dies.
"""

from __future__ import annotations

import hashlib
import mmap
import os
import platform
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...config.rig import RigConfig
from ...log.signals import cycle_dtype
from ..control.control_cycle import heat_of, heated_of, memory_shape
from .control_words import Board, Word
from .row_ring import Ring, ring_rows
from .segment_stream import Program
from .timing_histograms import Timing, WakeUps

_AHEAD_S = 4.0
"""How far the program is streamed ahead of the loop."""
_LEAST_ROWS = 4096
_PAGE = 4096
_ORDERED = ("x86_64", "i686")
"""Machines that show a process what another one wrote in the order in which it was written."""


class Shared:
    """Maps the memory of a rig's daemon; the first process makes it, the others get its `fd`.

    Ends the process where the memory was laid out by another levid: every word would be another's.
    """

    def __init__(self, rig: RigConfig, fd: int | None = None) -> None:
        coils, sensors = len(rig.geometry.coil_x_m), len(rig.geometry.sensors_x_m)
        self.dtype: np.dtype[np.void] = cycle_dtype(coils, sensors)
        rows = ring_rows(rig.recording, rig.rate_hz)
        program_rows = max(int(_AHEAD_S * rig.rate_hz), _LEAST_ROWS)
        control = memory_shape(coils, sensors)
        sizes = (
            Board.SIZE,
            Ring.size(self.dtype, rows),
            Program.size(coils, program_rows),
            Timing.SIZE,
            8 * int(np.prod(control)),
            WakeUps.SIZE,
        )
        ends = np.cumsum([-(-size // _PAGE) * _PAGE for size in sizes]).tolist()
        name = _name_of(self.dtype, ends)
        if fd is None:
            fd = os.memfd_create(name, os.MFD_CLOEXEC)
            os.ftruncate(fd, ends[-1])
        elif name not in (found := str(Path(f"/proc/self/fd/{fd}").readlink())):
            raise SystemExit(
                f"levid was replaced while its daemon ran: expected memory laid out as {name}, "
                f"found {found}; restart the daemon"
            )
        self.fd = fd
        memory = memoryview(mmap.mmap(fd, ends[-1]))
        self.board = Board(memory[: ends[0]])
        self.ring = Ring(self.dtype, rows, memory[ends[0] : ends[1]])
        self.program = Program(coils, program_rows, memory[ends[1] : ends[2]], self.board)
        self.timing = Timing(memory[ends[2] : ends[3]])
        words: NDArray[np.float64] = np.frombuffer(
            memory, np.float64, control[0] * control[1], ends[3]
        )
        self.control = words.reshape(control)
        """What a controller remembers: a loop that follows a dead one finds the coils as hot."""
        self.heat, self.heated = heat_of(self.control, coils), heated_of(self.control, coils)
        self.wake_ups = WakeUps(memory[ends[4] : ends[5]])

    @property
    def lost(self) -> int:
        """Rows written over before the recorder took them, and rows missing in their log.

        What a recorder that hangs is too slow for counts at once, not when it looks again.
        """
        unseen = max(self.ring.waiting - self.ring.capacity + 1, 0)
        return self.ring.lost + unseen + self.board[Word.DROPPED]

    def close(self) -> None:
        """Let go of the descriptor; the mapping goes with the process."""
        os.close(self.fd)


def doubts_of_order() -> list[str]:
    """Return a warning where a counter may be seen before what it announces; none on x86.

    A row, a word's detail, a segment are each written before the counter that tells of them, and
    nothing but the processor keeps them in this order.
    """
    machine = platform.machine()
    if machine in _ORDERED:
        return []
    return [
        f"levid was tried on {_ORDERED[0]} alone, this machine is {machine}: where processors show "
        "writes out of order, a row may reach the log, or a segment the loop, before it is whole"
    ]


def _name_of(dtype: np.dtype[np.void], ends: Sequence[int]) -> str:
    """Return the name of memory laid out like this, which the kernel keeps with it."""
    layout = repr((dtype.descr, list(ends), [word.name for word in Word]))
    return f"levid-{hashlib.sha256(layout.encode()).hexdigest()[:16]}"
