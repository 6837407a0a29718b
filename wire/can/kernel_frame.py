"""A CAN frame as Linux lays it out in memory, with the kernel's stamp of when it came."""

from __future__ import annotations

import socket
import struct
from collections.abc import Sequence
from typing import NamedTuple

ERROR_BUS_OFF = 0x40
"""linux/can/error.h, in the ID of an error frame."""
_NOT_PLAIN = 0xE000_0000
ERROR = 0x2000_0000
BUS_OFF_ID = ERROR | ERROR_BUS_OFF
"""Of the error frame by which a driver says that its controller has left the bus."""
FRAME_SIZES = (16, 72)
"""Bytes of a classic frame and of one of CAN FD, as the kernel lays them out."""
_BRS = 0x01
# struct canfd_frame of linux/can.h: ID with flags, length, flags, and the data behind two bytes;
# struct can_frame is the same but for its 16 bytes and no flags.
_HEAD = struct.Struct("=IBB2x")
_CLASSIC = struct.Struct("=IBB2x8s")
_FD = struct.Struct("=IBB2x64s")
_TIMESPEC = struct.Struct("@ll")
SO_TIMESTAMPNS = 35
"""asm-generic/socket.h: what python-can asks of socketcan too; Python has no name for it."""
STAMP_BYTES = socket.CMSG_SPACE(_TIMESPEC.size)
"""Room for a stamp beside a frame, in recvmsg."""


class BusOffError(Exception):
    """The controller has left the bus."""


class ReceivedFrame(NamedTuple):
    """What came: an 11-bit ID (-1 for frames that are no data of ours), and when, by time()."""

    can_id: int
    data: bytes
    stamp_s: float


OTHER = ReceivedFrame(-1, b"", 0.0)
"""With the stamp of what it stands for, where that has one: without, it counts as come just now."""


def packed(can_id: int, data: bytes) -> bytes:
    """Return a frame as the kernel lays it out: CAN FD with bit rate switch beyond 8 bytes."""
    length = len(data)
    if length > 8:
        return _FD.pack(can_id, length, _BRS, data)
    return _CLASSIC.pack(can_id, length, 0, data)


def unpacked(raw: bytes, stamp_s: float) -> ReceivedFrame:
    """Return what the kernel, or another process, laid out; raises BusOffError."""
    can_id, length, _ = _HEAD.unpack_from(raw)
    if can_id & _NOT_PLAIN:
        if can_id & ERROR and can_id & ERROR_BUS_OFF:
            raise BusOffError
        return OTHER._replace(stamp_s=stamp_s)
    data = raw[8 : 8 + length]
    if len(data) < length:  # no kernel says so, but on a local bus other processes may
        return OTHER._replace(stamp_s=stamp_s)
    return ReceivedFrame(can_id, data, stamp_s)


def kernel_stamp_s(ancillary: Sequence[tuple[int, int, bytes]]) -> float:
    """Return when a frame came, by the kernel's stamp beside it; 0.0 where there is none."""
    for level, kind, data in ancillary:  # other processes may send other things on a local bus
        wanted = (level, kind) == (socket.SOL_SOCKET, SO_TIMESTAMPNS)
        if wanted and len(data) == _TIMESPEC.size:
            seconds, nanoseconds = _TIMESPEC.unpack(data)
            return float(seconds + 1e-9 * nanoseconds)
    return 0.0
