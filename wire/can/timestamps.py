"""When a frame came, by the stamps of kernel and hardware."""

from __future__ import annotations

import contextlib
import math
import socket
import struct
from collections.abc import Sequence
from time import perf_counter, time

from .kernel_frame import SO_TIMESTAMPNS, STAMP_BYTES, kernel_stamp_s

_WINDOW_S = 1.0
"""Clocks that differ by 20 ppm are 0.04 ms apart after twice that."""
OLDEST_S = 1.0
"""A frame that seems to have waited for longer has a stamp that tells nothing."""

SO_TIMESTAMPING = 37
"""asm-generic/socket.h; the message beside a frame has the same number."""
_RX_HARDWARE, _RX_SOFTWARE, _SOFTWARE, _RAW_HARDWARE = 1 << 2, 1 << 3, 1 << 4, 1 << 6
_WANTED = _RX_HARDWARE | _RAW_HARDWARE | _RX_SOFTWARE | _SOFTWARE
"""SOF_TIMESTAMPING_* of linux/net_tstamp.h. CAN drivers stamp whatever comes: nobody has to switch
that on in the interface, as in one of Ethernet."""
_THREE = struct.Struct("@llllll")
"""struct scm_timestamping: the kernel's stamp, nothing, and that of hardware."""

Ancillary = Sequence[tuple[int, int, bytes]]


class HardwareClock:
    """Tells how old stamps are of hardware that counts from its own start, slower or faster.

    Of all frames of the last seconds the one that came quickest says how far the clocks are apart,
    and counts as of no age.
    """

    def __init__(self) -> None:
        self._apart_s = self._apart_before_s = math.inf
        self._since_s = -math.inf

    def age_s(self, stamp_s: float, seen_s: float) -> float | None:
        """Return how old a frame was when this host saw it, None where nobody can tell.

        `seen_s` is of a clock that is never set, as perf_counter: by a time of day that jumps,
        frames of the next seconds would seem to be late.
        """
        apart_s = seen_s - stamp_s
        if not 0.0 <= seen_s - self._since_s < _WINDOW_S:
            self._apart_before_s, self._apart_s, self._since_s = self._apart_s, apart_s, seen_s
        self._apart_s = min(self._apart_s, apart_s)
        age_s = apart_s - min(self._apart_s, self._apart_before_s)
        if age_s < OLDEST_S:
            return age_s
        # The stamps have begun anew: a counter that is full, say.
        self._apart_s = self._apart_before_s = apart_s
        return None


class KernelStamps:
    """Asks a socket for stamps, of hardware too where its controller has them, and reads them."""

    room = STAMP_BYTES + socket.CMSG_SPACE(_THREE.size)
    """For stamps of both kinds beside a frame, in recvmsg: who was asked before goes on."""

    def __init__(self, end: socket.socket) -> None:
        self._hardware = HardwareClock()
        try:
            end.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPING, _WANTED)
        except OSError:  # without any a frame is as old as when it is looked at
            with contextlib.suppress(OSError):
                end.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 1)

    def came_s(self, ancillary: Ancillary) -> float:
        """Return when a frame came, by time(), from what is beside it; 0.0 where nothing tells.

        Hardware's stamp is of the frame itself; the kernel's, with which hardware's clock is
        followed, of the moment when it got to it: later by what interrupts and USB take.
        """
        kernel_s, hardware_s = kernel_stamp_s(ancillary), 0.0
        for level, kind, data in ancillary:
            if (level, kind) == (socket.SOL_SOCKET, SO_TIMESTAMPING) and len(data) == _THREE.size:
                s, ns, _, _, hardware, hardware_ns = _THREE.unpack(data)
                kernel_s = (s + 1e-9 * ns) or kernel_s
                hardware_s = hardware + 1e-9 * hardware_ns
        if hardware_s <= 0.0:
            return kernel_s
        now_s = time()
        waited_s = now_s - kernel_s
        if not 0.0 <= waited_s < OLDEST_S:
            kernel_s, waited_s = now_s, 0.0
        return kernel_s - (self._hardware.age_s(hardware_s, perf_counter() - waited_s) or 0.0)
