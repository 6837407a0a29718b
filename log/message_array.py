"""Lay out fixed-size CDR messages in an MCAP chunk as one numpy array."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from mcap.opcode import Opcode
from numpy.typing import NDArray

from .errors import LogError
from .mcap_scan import MESSAGE_HEAD_BYTES, RECORD_HEAD, records

CDR_LE, CDR_BE = b"\x00\x01", b"\x00\x00"
_CHANNEL = slice(RECORD_HEAD.size, RECORD_HEAD.size + 2)
_CDR = slice(MESSAGE_HEAD_BYTES, MESSAGE_HEAD_BYTES + 2)
# Some CDR writers pad the payload to a multiple of 4 or 8 bytes.
_MAX_PADDING = 7
MESSAGE_BYTES = MESSAGE_HEAD_BYTES + 4 + 16
"""Bytes of a message beside its payload: its head, the CDR header, its entry in the index."""


@dataclass(frozen=True)
class MessageLayout:
    """The layout of one channel's messages: its number, the payload's dtype, CDR byte order."""

    channel: int
    payload: np.dtype[np.void]
    cdr: bytes = CDR_LE

    @cached_property
    def dtype(self) -> np.dtype[np.void]:
        """The packed dtype of a message record; head is opcode, length and channel."""
        return np.dtype(
            [
                ("head", "V11"),
                ("sequence", "<u4"),
                ("log_time", "<u8"),
                ("publish_time", "<u8"),
                ("cdr", "V2"),
                ("cdr_options", "V2"),
                # As bytes: numpy copies these fast, without the interpreter's lock.
                ("payload", "u1", (self.payload.itemsize,)),
            ]
        )

    def zeros(self, count: int) -> NDArray[np.void]:
        """Return message records (count,) with head and CDR header, otherwise zero."""
        messages = np.zeros(count, self.dtype)
        messages["head"] = np.void(self._head(self.dtype.itemsize))
        messages["cdr"] = np.void(self.cdr)
        return messages

    def find(self, raw: memoryview, where: str) -> NDArray[np.void]:
        """Return the channel's messages, (n,) of `dtype`, in the records `raw` of a chunk.

        Raises:
            LogError: a record is cut off, or a message does not have the size of the schema or the
                byte order of the first message.
        """
        alike = self._alike(raw)
        return self._among_others(raw, where) if alike is None else alike

    def _head(self, size: int) -> bytes:
        head = RECORD_HEAD.pack(Opcode.MESSAGE, size - RECORD_HEAD.size)
        return head + self.channel.to_bytes(2, "little")

    def _alike(self, raw: memoryview) -> NDArray[np.void] | None:
        """Return a view of the messages; None if other records lie between them."""
        begin = 0
        while len(raw) - begin >= self.dtype.itemsize and raw[begin] in (
            Opcode.SCHEMA,
            Opcode.CHANNEL,
        ):
            begin += RECORD_HEAD.size + RECORD_HEAD.unpack_from(raw, begin)[1]
        if len(raw) - begin < self.dtype.itemsize:
            return None
        stride = RECORD_HEAD.size + RECORD_HEAD.unpack_from(raw, begin)[1]
        count, rest = divmod(len(raw) - begin, stride)
        if rest or not 0 <= stride - self.dtype.itemsize <= _MAX_PADDING:
            return None
        messages: NDArray[np.void] = np.ndarray((count,), self.dtype, raw, begin, (stride,))
        for name, expected in (("head", self._head(stride)), ("cdr", self.cdr)):
            if messages[name].tobytes() != expected * count:
                return None
        return messages

    def _among_others(self, raw: memoryview, where: str) -> NDArray[np.void]:
        """Return a copy of the messages among those of other channels."""
        channel, size = self.channel.to_bytes(2, "little"), self.dtype.itemsize
        found = []
        for opcode, at, end in records(raw, where=where):
            message = raw[at:end]
            if opcode != Opcode.MESSAGE or message[_CHANNEL] != channel:
                continue
            if not 0 <= len(message) - size <= _MAX_PADDING:
                raise LogError(
                    f"{where}byte {at}: expected messages of {size - MESSAGE_HEAD_BYTES} bytes, as "
                    f"their schema says, found one of {len(message) - MESSAGE_HEAD_BYTES}"
                )
            if message[_CDR] != self.cdr:
                raise LogError(
                    f"{where}byte {at}: expected CDR that starts with {self.cdr.hex(' ')}, as in "
                    f"the first message, found {message[_CDR].hex(' ')}"
                )
            found.append(message[:size])
        return np.ndarray((len(found),), self.dtype, b"".join(found))


def byte_order(raw: memoryview, channel: int, where: str) -> bytes | None:
    """Return CDR_LE or CDR_BE from the channel's first message in a chunk, None if it has none."""
    for opcode, at, end in records(raw, where=where):
        message = raw[at:end]
        if opcode == Opcode.MESSAGE and message[_CHANNEL] == channel.to_bytes(2, "little"):
            cdr = bytes(message[_CDR])
            if cdr not in (CDR_LE, CDR_BE):
                raise LogError(
                    f"{where}byte {at}: expected messages that start with 00 01 (CDR, little "
                    f"endian) or 00 00 (big endian), found {cdr.hex(' ') or 'none'}"
                )
            return cdr
    return None
