"""Pack and unpack CAN frames in the memory layout of Linux, and read the kernel's timestamp."""

from __future__ import annotations

import socket
import struct
from collections.abc import Sequence
from typing import NamedTuple

ERROR_BUS_OFF = 0x40
"""Flag in the ID of an error frame (linux/can/error.h)."""
_NOT_PLAIN = 0xE000_0000
ERROR = 0x2000_0000
BUS_OFF_ID = ERROR | ERROR_BUS_OFF
"""ID of the error frame with which a driver reports bus-off."""
FRAME_SIZES = (16, 72)
"""Bytes of a classic frame and of a CAN FD frame in the kernel's layout."""
_BRS = 0x01
# struct canfd_frame of linux/can.h: ID with flags, length, flags, two reserved bytes, data;
# struct can_frame is the same with 16 bytes and without flags.
_HEAD = struct.Struct("=IBB2x")
_CLASSIC = struct.Struct("=IBB2x8s")
_FD = struct.Struct("=IBB2x64s")
_TIMESPEC = struct.Struct("@ll")
SO_TIMESTAMPNS = 35
"""asm-generic/socket.h; python-can sets it on socketcan. The socket module has no name for it."""
STAMP_BYTES = socket.CMSG_SPACE(_TIMESPEC.size)
"""Ancillary bytes of a timestamp, for recvmsg."""


class BusOffError(Exception):
    """The controller has left the bus."""


class ReceivedFrame(NamedTuple):
    """A received frame: 11-bit ID (-1: ignore it), data, time of receipt by time()."""

    can_id: int
    data: bytes
    stamp_s: float


OTHER = ReceivedFrame(-1, b"", 0.0)
"""A frame to ignore; a timestamp of 0 means that it was received just now."""


def pack_frame(can_id: int, data: bytes) -> bytes:
    """Return a frame in the kernel's layout: CAN FD with bit rate switch above 8 bytes."""
    length = len(data)
    if length > 8:
        return _FD.pack(can_id, length, _BRS, data)
    return _CLASSIC.pack(can_id, length, 0, data)


def unpack_frame(raw: bytes, stamp_s: float) -> ReceivedFrame:
    """Return the frame in `raw`, from the kernel or another process; raises BusOffError."""
    can_id, length, _ = _HEAD.unpack_from(raw)
    if can_id & _NOT_PLAIN:
        if can_id & ERROR and can_id & ERROR_BUS_OFF:
            raise BusOffError
        return OTHER._replace(stamp_s=stamp_s)
    data = raw[8 : 8 + length]
    if len(data) < length:  # not from a kernel, but possible on a local bus
        return OTHER._replace(stamp_s=stamp_s)
    return ReceivedFrame(can_id, data, stamp_s)


def kernel_stamp_s(ancillary: Sequence[tuple[int, int, bytes]]) -> float:
    """Return the kernel's timestamp of a frame, 0.0 if there is none."""
    for level, kind, data in ancillary:  # on a local bus, processes may send other data
        wanted = (level, kind) == (socket.SOL_SOCKET, SO_TIMESTAMPNS)
        if wanted and len(data) == _TIMESPEC.size:
            seconds, nanoseconds = _TIMESPEC.unpack(data)
            return float(seconds + 1e-9 * nanoseconds)
    return 0.0
