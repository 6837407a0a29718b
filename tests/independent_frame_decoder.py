"""Judge received frames without levid's decoders, and change good frames at random.

The checksum of CAN frames is computed a bit at a time, that of serial frames by zlib, and numbers
are read by struct. Layouts are those of docs/can.md and docs/serial-protocol.md.
"""

from __future__ import annotations

import math
import struct
import zlib
from collections.abc import Iterable, Sequence

import numpy as np
from hypothesis import strategies as st

CYCLES = 61_440
SERIAL_BODIES = {0x01: 18 + 24, 0x81: 20 + 20 + 4 + 36, 0x02: 6, 0x82: 5}
"""Bytes of the body of each kind of serial frame, with nine coils, nine sensors and drives."""
OF_CYCLES = (0x01, 0x81)
_NO_VALUE = -(2**15)
_NO_POSITION = -(2**31)

PLACES = st.integers(0, 127)
CHANGES = st.lists(
    st.one_of(
        st.tuples(st.just("flip"), PLACES, st.integers(1, 255)),
        st.tuples(st.just("bit"), PLACES, st.integers(0, 7)),
        st.tuples(st.just("cut"), PLACES, st.none()),
        st.tuples(st.just("insert"), PLACES, st.binary(min_size=1, max_size=4)),
        st.tuples(st.just("append"), st.just(0), st.binary(min_size=1, max_size=4)),
    ),
    min_size=1,
    max_size=3,
)
"""What happens to a frame on its way; `changed` applies it."""


def changed(good: bytes, changes: Iterable[tuple[str, int, object]]) -> bytes:
    """Return a frame after these changes; places after its end start again at its beginning."""
    data = bytearray(good)
    for kind, place, what in changes:
        at = place % (len(data) + 1)
        if kind == "cut":
            del data[at:]
        elif kind == "insert":
            data[at:at] = what
        elif kind == "append":
            data += what
        elif at < len(data):
            data[at] ^= what if kind == "flip" else 1 << what
    return bytes(data)


def equal(found: np.ndarray, expected: Sequence[float]) -> bool:
    """Return whether these are the expected numbers, to the rounding of a product."""
    return np.allclose(found, expected, rtol=1e-12, atol=0.0, equal_nan=True)


def scaled(data: bytes, unit: float) -> list[float]:
    """Return 16-bit numbers in SI units, nan for a missing value."""
    counts = struct.unpack(f"<{len(data) // 2}h", data)
    return [c * unit if c != _NO_VALUE else math.nan for c in counts]


def crc8(data: bytes) -> int:
    """Return CRC-8/AUTOSAR, a bit at a time: polynomial 0x2F, initial value and final xor 0xFF."""
    crc = 0xFF
    for byte in data:
        for bit in range(7, -1, -1):
            carry = (crc >> 7) ^ (byte >> bit & 1)
            crc = crc << 1 & 0xFF ^ (0x2F if carry else 0)
    return crc ^ 0xFF


def can_sealed(can_id: int, data: bytes, cycle: int | None = None) -> bytes:
    """Return a CAN payload whose last byte is replaced by the right checksum.

    The checksum of a frame of values covers the upper bits of `cycle` too.
    """
    head = struct.pack(">H", can_id) + (b"" if cycle is None else struct.pack(">H", cycle >> 4))
    return data[:-1] + bytes((crc8(head + data[:-1]),)) if data else data


def can_values_right(can_id: int, data: bytes, cycle: int, length: int) -> bool:
    """Return whether a frame of values must be accepted: length, counter and checksum are right."""
    fits = len(data) == length and not (data[-2] ^ cycle) & 0xF
    return fits and data == can_sealed(can_id, data, cycle)


def can_values(payloads: Iterable[bytes], unit: float) -> list[float]:
    """Return the values of the frames of a cycle in SI units."""
    return [value for data in payloads for value in scaled(data[:-2], unit)]


class FramesTogether:
    """The frames of one CAN cycle: the first of each ID whose length and counter fit."""

    def __init__(self, ids: tuple[int, ...], length: int) -> None:
        self._ids, self._length = ids, length
        self.parts: dict[int, bytes] = {}

    @property
    def complete(self) -> bool:
        return len(self.parts) == len(self._ids)

    def take(self, can_id: int, data: bytes, cycle: int) -> bool:
        """Take a frame; return whether it fits, and is the first of its ID."""
        fits = can_id in self._ids and len(data) == self._length and not (data[-2] ^ cycle) & 0xF
        first = fits and can_id not in self.parts
        if first:
            self.parts[can_id] = data
        return first

    def right(self, cycle: int) -> bool:
        """Return whether all frames are there and their checksums are right."""
        sealed = [can_values_right(i, d, cycle, self._length) for i, d in self.parts.items()]
        return self.complete and all(sealed)

    def values(self, unit: float) -> list[float]:
        return can_values((self.parts[can_id] for can_id in self._ids), unit)


def stuffed(raw: bytes) -> bytes:
    """Return COBS of `raw`, without the final zero."""
    out = bytearray()
    parts = raw.split(b"\0")
    for i, part in enumerate(parts):
        rest = part
        while len(rest) >= 254:
            out += b"\xff" + rest[:254]
            rest = rest[254:]
            if not rest and i + 1 == len(parts):
                return bytes(out)
        out += bytes((len(rest) + 1,)) + rest
    return bytes(out)


def unstuffed(block: bytes) -> bytes:
    """Undo COBS; empty if the block is not COBS."""
    raw, at = bytearray(), 0
    while at < len(block):
        code = block[at]
        part = block[at + 1 : at + code]
        if code == 0 or len(part) != code - 1 or 0 in part:
            return b""
        raw += part
        at += code
        if code < 0xFF and at < len(block):
            raw.append(0)
    return bytes(raw)


def serial_sealed(raw: bytes) -> bytes:
    """Return the block of a serial frame: `raw` and its checksum, stuffed."""
    return stuffed(raw + struct.pack("<I", zlib.crc32(raw)))


def serial_frame(block: bytes) -> tuple[int, int, bytes] | None:
    """Return kind, sequence number and body of a block, None if it must be rejected."""
    raw = unstuffed(block)
    if len(raw) < 8 or zlib.crc32(raw[:-4]) != int.from_bytes(raw[-4:], "little"):
        return None
    kind, number, body = raw[1], raw[2] | raw[3] << 8, raw[4:-4]
    right = raw[0] == 1 and SERIAL_BODIES.get(kind) == len(body)
    return (kind, number, body) if right and (kind not in OF_CYCLES or number < CYCLES) else None


def axis(data: bytes, unit: float) -> list[float]:
    """Return position, velocity and third number of 12 bytes, nan for a missing position."""
    counts, second, third = struct.unpack("<iff", data)
    return [counts * unit if counts != _NO_POSITION else math.nan, second, third]
