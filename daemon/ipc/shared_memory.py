"""Shared memory of the daemon's processes: control words, ring of rows, stream of segments.

The memory is anonymous and inherited as a file descriptor: other processes cannot open it, and the
kernel frees it when the last process ends.
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
from ..control.controller_memory import heat_of, heated_of, memory_shape
from .flight_segment_stream import SegmentStream
from .memory_fences import ORDERED
from .row_ring import Ring, ring_rows
from .shared_status_words import ControlWords, Word
from .timing_histograms import Timing, WakeUps

_AHEAD_S = 4.0
"""Time for which rows are streamed ahead of the loop."""
_MIN_ROWS = 4096
_PAGE = 4096


class SharedMemory:
    """Map the shared memory of a rig's daemon; the first process creates it, others pass its `fd`.

    With `read_only` the kernel refuses every write; pass a descriptor of `read_only_fd`.
    Raises SystemExit if another version of levid created the memory with a different layout.
    """

    def __init__(self, rig: RigConfig, fd: int | None = None, read_only: bool = False) -> None:
        coils, sensors = len(rig.geometry.coil_x_m), len(rig.geometry.sensors_x_m)
        self.dtype: np.dtype[np.void] = cycle_dtype(coils, sensors)
        rows = ring_rows(rig.recording, rig.rate_hz)
        segment_rows = max(int(_AHEAD_S * rig.rate_hz), _MIN_ROWS)
        control = memory_shape(coils, sensors)
        sizes = (
            ControlWords.SIZE,
            Ring.size(self.dtype, rows),
            SegmentStream.size(coils, segment_rows),
            Timing.SIZE,
            8 * int(np.prod(control)),
            WakeUps.SIZE,
        )
        ends = np.cumsum([-(-size // _PAGE) * _PAGE for size in sizes]).tolist()
        name = _name_of(self.dtype, ends)
        if fd is None:
            fd = os.memfd_create(name, os.MFD_CLOEXEC)
            os.ftruncate(fd, ends[-1])
            # Other users must not open it again for writing through /proc/self/fd.
            os.fchmod(fd, 0o600)
        elif name not in (found := str(Path(f"/proc/self/fd/{fd}").readlink())):
            raise SystemExit(
                f"levid was upgraded while its daemon ran: expected shared memory {name}, "
                f"found {found}; restart the daemon"
            )
        self.fd = fd
        protection = mmap.PROT_READ if read_only else mmap.PROT_READ | mmap.PROT_WRITE
        memory = memoryview(mmap.mmap(fd, ends[-1], prot=protection))
        self.control_words = ControlWords(memory[: ends[0]])
        self.ring = Ring(self.dtype, rows, memory[ends[0] : ends[1]])
        self.segment_stream = SegmentStream(
            coils, segment_rows, memory[ends[1] : ends[2]], self.control_words
        )
        self.timing = Timing(memory[ends[2] : ends[3]])
        words: NDArray[np.float64] = np.frombuffer(
            memory, np.float64, control[0] * control[1], ends[3]
        )
        self.control = words.reshape(control)
        """Memory of the controller: a restarted loop continues with the same coil heat."""
        self.heat, self.heated = heat_of(self.control, coils), heated_of(self.control, coils)
        self.wake_ups = WakeUps(memory[ends[4] : ends[5]])

    @property
    def lost(self) -> int:
        """Rows overwritten before the recorder read them, and rows missing in their log.

        Rows that a hung recorder loses count at once, before it reads again.
        """
        unseen = max(self.ring.waiting - self.ring.capacity + 1, 0)
        return self.ring.lost + unseen + self.control_words[Word.DROPPED]

    def read_only_fd(self) -> int:
        """Open a descriptor that the kernel lets nobody map for writing. Raises OSError."""
        return os.open(f"/proc/self/fd/{self.fd}", os.O_RDONLY | os.O_CLOEXEC)

    def close(self) -> None:
        """Close the descriptor; the mapping lasts until the process ends."""
        os.close(self.fd)


def memory_order_warnings() -> list[str]:
    """Return a warning if the processor may reorder stores; empty on x86: see memory_fences."""
    machine = platform.machine()
    if machine in ORDERED:
        return []
    return [
        f"levid was tested on {ORDERED[0]} only, this machine is {machine}: the fences of the "
        "memory that its processes share are compiled, but nobody has flown with them"
    ]


def _name_of(dtype: np.dtype[np.void], ends: Sequence[int]) -> str:
    """Return a name of the memory that contains a hash of its layout; the kernel stores it."""
    layout = repr((dtype.descr, list(ends), [word.name for word in Word]))
    return f"levid-{hashlib.sha256(layout.encode()).hexdigest()[:16]}"
