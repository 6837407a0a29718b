"""Records of the MCAP container (mcap.dev/spec): their bytes, written and read."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from .errors import LogError

MAGIC = b"\x89MCAP0\r\n"
CDR_LE = b"\x00\x01\x00\x00"
CDR_BE = b"\x00\x00\x00\x00"
RECORD_HEAD = struct.Struct("<BQ")  # opcode, length of what follows
MESSAGE_HEAD = struct.Struct("<HIQQ")  # channel, sequence, log time, publish time
CHUNK_HEAD = struct.Struct("<QQQII")  # start, end, size, CRC, length of the compression's name


class Op(IntEnum):
    """Opcodes; those from 0x80 on are private to whoever wrote them."""

    HEADER = 0x01
    FOOTER = 0x02
    SCHEMA = 0x03
    CHANNEL = 0x04
    MESSAGE = 0x05
    CHUNK = 0x06
    MESSAGE_INDEX = 0x07
    CHUNK_INDEX = 0x08
    ATTACHMENT = 0x09
    ATTACHMENT_INDEX = 0x0A
    STATISTICS = 0x0B
    METADATA = 0x0C
    METADATA_INDEX = 0x0D
    SUMMARY_OFFSET = 0x0E
    DATA_END = 0x0F


MESSAGE_INDEX_ENTRY = np.dtype([("time", "<u8"), ("offset", "<u8")])


def message_dtype(payload: np.dtype[np.void]) -> np.dtype[np.void]:
    """Return the packed dtype of a whole message record, head and CDR header included."""
    return np.dtype(
        [
            ("opcode", "u1"),
            ("length", "<u8"),
            ("channel", "<u2"),
            ("sequence", "<u4"),
            ("log_time", "<u8"),
            ("publish_time", "<u8"),
            ("cdr", "V4"),
            ("payload", payload),
        ]
    )


def record(opcode: Op, *parts: bytes) -> bytes:
    """Return one record: opcode, length, then its parts."""
    body = b"".join(parts)
    return RECORD_HEAD.pack(opcode, len(body)) + body


def string(text: str) -> bytes:
    """Return a string in UTF-8 after its length; what is no text, as in a file's name, as '?'."""
    data = text.encode("utf-8", "replace")
    return struct.pack("<I", len(data)) + data


def string_map(mapping: Mapping[str, str]) -> bytes:
    """Return pairs of strings after their length in bytes, in the order of the mapping."""
    data = b"".join(string(key) + string(value) for key, value in mapping.items())
    return struct.pack("<I", len(data)) + data


def schema(number: int, name: str, encoding: str, data: bytes) -> bytes:
    """Return a Schema record."""
    head = struct.pack("<H", number) + string(name) + string(encoding)
    return record(Op.SCHEMA, head, struct.pack("<I", len(data)), data)


def channel(number: int, schema_number: int, topic: str, encoding: str) -> bytes:
    """Return a Channel record without metadata."""
    head = struct.pack("<HH", number, schema_number)
    return record(Op.CHANNEL, head, string(topic), string(encoding), string_map({}))


def attachment(name: str, media_type: str, data: bytes) -> bytes:
    """Return an Attachment record with its CRC; the times are 0, for 'not known'."""
    head = struct.pack("<QQ", 0, 0) + string(name) + string(media_type)
    body = head + struct.pack("<Q", len(data)) + data
    return record(Op.ATTACHMENT, body, struct.pack("<I", zlib.crc32(body)))


def attachment_index(offset: int, length: int, name: str, media_type: str, size: int) -> bytes:
    """Return the AttachmentIndex of an `attachment` of `length` bytes at `offset` of the file."""
    head = struct.pack("<QQQQQ", offset, length, 0, 0, size)
    return record(Op.ATTACHMENT_INDEX, head, string(name), string(media_type))


def metadata(name: str, mapping: Mapping[str, str]) -> bytes:
    """Return a Metadata record."""
    return record(Op.METADATA, string(name), string_map(mapping))


def metadata_index(offset: int, length: int, name: str) -> bytes:
    """Return the MetadataIndex of a `metadata` of `length` bytes at `offset` of the file."""
    return record(Op.METADATA_INDEX, struct.pack("<QQ", offset, length), string(name))


def chunk(start: int, end: int, raw: NDArray[np.uint8], compression: str, packed: bytes) -> bytes:
    """Return a Chunk of the records `raw`, times in ns, with their CRC."""
    head = struct.pack("<QQQI", start, end, raw.size, zlib.crc32(raw.data)) + string(compression)
    return record(Op.CHUNK, head, struct.pack("<Q", len(packed)), packed)


def message_index(channel_number: int, times: NDArray[np.uint64], stride: int) -> bytes:
    """Return the MessageIndex of a chunk that holds messages of `stride` bytes and nothing else."""
    entries = np.empty(times.size, MESSAGE_INDEX_ENTRY)
    entries["time"] = times
    entries["offset"] = np.arange(times.size, dtype=np.uint64) * np.uint64(stride)
    head = struct.pack("<HI", channel_number, entries.nbytes)
    return record(Op.MESSAGE_INDEX, head, entries.tobytes())


def data_end(crc: int) -> bytes:
    """Return the DataEnd record; `crc` is that of all bytes before it."""
    return record(Op.DATA_END, struct.pack("<I", crc))


def footer(summary_start: int, offsets_start: int, summary: bytes) -> bytes:
    """Return the Footer; its CRC is over `summary` and the footer's own first fields."""
    body = struct.pack("<QQ", summary_start, offsets_start)
    crc = zlib.crc32(RECORD_HEAD.pack(Op.FOOTER, len(body) + 4) + body, zlib.crc32(summary))
    return record(Op.FOOTER, body, struct.pack("<I", crc))


@dataclass(frozen=True)
class Schema:
    """A Schema record."""

    name: str
    encoding: str
    data: bytes


@dataclass(frozen=True)
class Channel:
    """A Channel record."""

    schema: int
    topic: str
    encoding: str


class Cursor:
    """Takes values off the body of one record; running over its end is a LogError."""

    def __init__(self, data: memoryview, begin: int, end: int) -> None:
        self._data, self._at, self._begin, self._end = data, begin, begin, end

    def take(self, count: int) -> memoryview:
        """Return the next `count` bytes."""
        if count > self._end - self._at:
            raise LogError(
                f"byte {self._at}: expected {count} more bytes in the record, "
                f"found {self._end - self._at}"
            )
        self._at += count
        return self._data[self._at - count : self._at]

    def integers(self, layout: str) -> tuple[int, ...]:
        """Return little-endian integers as `struct` spells them."""
        return struct.unpack("<" + layout, self.take(struct.calcsize("<" + layout)))

    def string(self) -> str:
        """Return a string with its length before it."""
        at = self._at
        (length,) = self.integers("I")
        try:
            return str(self.take(length), "utf-8")
        except UnicodeDecodeError:
            raise LogError(f"byte {at}: expected text in UTF-8") from None

    def string_map(self) -> dict[str, str]:
        """Return pairs of strings with their length in bytes before them."""
        (length,) = self.integers("I")
        inner = type(self)(self._data, self._at, self._at + len(self.take(length)))
        pairs = {}
        while inner.left:
            key = inner.string()
            pairs[key] = inner.string()
        return pairs

    @property
    def left(self) -> int:
        """Bytes that have not been taken."""
        return self._end - self._at

    @property
    def at(self) -> int:
        """Offset in the file of the next byte."""
        return self._at

    def schema(self) -> tuple[int, Schema]:
        """Return number and content of a Schema record."""
        (number,) = self.integers("H")
        name, encoding = self.string(), self.string()
        (length,) = self.integers("I")
        return number, Schema(name, encoding, bytes(self.take(length)))

    def channel(self) -> tuple[int, Channel]:
        """Return number and content of a Channel record."""
        number, schema_number = self.integers("HH")
        return number, Channel(schema_number, self.string(), self.string())

    def attachment(self) -> tuple[str, bytes]:
        """Return name and data of an Attachment record whose CRC, if any, is right."""
        self.integers("QQ")
        name, _ = self.string(), self.string()
        (length,) = self.integers("Q")
        data = self.take(length)
        end = self._at
        (crc,) = self.integers("I")
        check_crc(f"byte {self._begin}: attachment '{name}'", self._data[self._begin : end], crc)
        return name, bytes(data)


def check_crc(where: str, data: memoryview | bytes, expected: int) -> None:
    """Raise LogError unless `data` has the CRC-32 `expected`; 0 stands for 'none given'."""
    if expected and (found := zlib.crc32(data)) != expected:
        raise LogError(f"{where}: expected CRC {expected:08x}, found {found:08x}")
