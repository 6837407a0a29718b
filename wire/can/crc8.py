"""The checksum of CAN payloads: CRC-8/AUTOSAR, two bytes a step."""

from __future__ import annotations

import struct

import numpy as np

_POLYNOMIAL = 0x2F
_INIT = _XOR_OUT = 0xFF


def _table_of_bytes() -> bytes:
    table = []
    for value in range(256):
        crc = value
        for _ in range(8):
            crc = (crc << 1) ^ (_POLYNOMIAL if crc & 0x80 else 0)
            crc &= 0xFF
        table.append(crc)
    return bytes(table)


_BYTE = _table_of_bytes()
# A step over two bytes at once halves what a checksum costs in pure Python.
CRC_TABLE = np.frombuffer(_BYTE, np.uint8)
"""The checksum's table (256,), for compiled code."""
_WORD = CRC_TABLE[CRC_TABLE[np.arange(65536) >> 8] ^ (np.arange(65536) & 0xFF)].tobytes()


def crc8(data: bytes, start: int = _INIT) -> int:
    """Return CRC-8/AUTOSAR (poly 0x2F, init and final xor 0xFF) of `data`, one byte a step."""
    crc = start
    for byte in data:
        crc = _BYTE[crc ^ byte]
    return crc ^ _XOR_OUT


class FrameCrc:
    """The checksum of frames of one CAN ID and one length.

    It covers the ID, high byte first, and then the payload but for its last byte, where it stands:
    a frame that arrives under another ID does not pass (AUTOSAR E2E profile 2 calls it data ID).
    Where a frame carries the low four bits of a cycle, the checksum covers the bits above too,
    after the ID, high byte first: they are not sent, both ends know them from Sync. So a frame that
    comes 16 cycles late is not taken for one of the cycle at hand.
    """

    start: int
    """What the checksum is before the payload's first byte."""

    def __init__(self, can_id: int, length: int) -> None:
        words, self._odd = divmod(length - 1, 2)
        self._words = struct.Struct(f">{words}H").unpack_from
        self.start = crc8(struct.pack(">H", can_id & 0xFFFF)) ^ _XOR_OUT
        self._last = length - 2

    def of(self, data: bytes | bytearray, cycle: int | None = None) -> int:
        """Return the checksum of a frame (of `cycle`, if it has one); its last byte is left out."""
        crc = self.start
        word = _WORD
        if cycle is not None:
            crc = word[(crc << 8) ^ (cycle >> 4)]
        for value in self._words(data):
            crc = word[(crc << 8) ^ value]
        if self._odd:
            crc = _BYTE[crc ^ data[self._last]]
        return crc ^ _XOR_OUT
