"""Compute the time of receipt of a frame from timestamps of kernel and hardware."""

from __future__ import annotations

import contextlib
import math
import socket
import struct
from collections.abc import Sequence
from time import perf_counter, time

from .kernel_frame import SO_TIMESTAMPNS, STAMP_BYTES, kernel_stamp_s

_WINDOW_S = 1.0
"""Window of the clock offset. Clocks that differ by 20 ppm drift by 0.04 ms in two windows."""
OLDEST_S = 1.0
"""Largest age in s; a timestamp that gives a larger one is ignored."""

SO_TIMESTAMPING = 37
"""asm-generic/socket.h; the ancillary message has the same number."""
_RX_HARDWARE, _RX_SOFTWARE, _SOFTWARE, _RAW_HARDWARE = 1 << 2, 1 << 3, 1 << 4, 1 << 6
_WANTED = _RX_HARDWARE | _RAW_HARDWARE | _RX_SOFTWARE | _SOFTWARE
"""SOF_TIMESTAMPING_* of linux/net_tstamp.h. CAN drivers always stamp; unlike Ethernet, nothing has
to be enabled in the interface."""
_THREE = struct.Struct("@llllll")
"""struct scm_timestamping: the kernel's timestamp, an unused one, the hardware's."""

Ancillary = Sequence[tuple[int, int, bytes]]


class HardwareClock:
    """Computes the age of hardware timestamps, whose clock has an unknown offset and drift.

    The fastest frame of the last one to two windows gives the offset; its age is 0 by definition.
    """

    def __init__(self) -> None:
        self._offset_s = self._offset_before_s = math.inf
        self._since_s = -math.inf

    def age_s(self, stamp_s: float, read_s: float) -> float | None:
        """Return the age of a frame in s when it was read, None if it is unknown.

        `read_s` is of a monotonic clock, such as perf_counter: after a jump of the time of day,
        frames would seem late for seconds.
        """
        offset_s = read_s - stamp_s
        if not 0.0 <= read_s - self._since_s < _WINDOW_S:
            self._offset_before_s, self._offset_s, self._since_s = self._offset_s, offset_s, read_s
        self._offset_s = min(self._offset_s, offset_s)
        age_s = offset_s - min(self._offset_s, self._offset_before_s)
        if age_s < OLDEST_S:
            return age_s
        # The hardware clock restarted, for example by an overflow.
        self._offset_s = self._offset_before_s = offset_s
        return None


class KernelStamps:
    """Enables timestamps of kernel and hardware on a socket, and reads them."""

    room = STAMP_BYTES + socket.CMSG_SPACE(_THREE.size)
    """Ancillary bytes of both kinds of timestamp, for recvmsg."""

    def __init__(self, end: socket.socket) -> None:
        self._hardware = HardwareClock()
        try:
            end.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPING, _WANTED)
        except OSError:  # not supported: fall back to the kernel's
            with contextlib.suppress(OSError):
                end.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 1)

    def received_s(self, ancillary: Ancillary) -> float:
        """Return the time of receipt of a frame by time(), 0.0 without a timestamp.

        The hardware stamps the frame on the bus; the kernel stamps it later, by the latency of
        interrupts and USB, and serves to track the hardware clock.
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
