"""What an MCAP file holds: schemas, channels, metadata, and where its messages lie."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import NamedTuple

import lz4.frame
import zstandard

from .errors import LogError
from .mcap_format import CHUNK_HEAD, MAGIC, RECORD_HEAD, Channel, Cursor, Op, Schema, check_crc

# A corrupt size must not ask for gigabytes; common writers make chunks of 1 to 16 MiB.
MAX_CHUNK_BYTES = 256 << 20
_LZ4_BEST_RATIO = 255
_RUN_BYTES = 16 << 20
"""Messages outside of chunks are read in runs of about this size, which threads share."""
_HEAD = "levid-head"


class Segment(NamedTuple):
    """Records that lie together: the inside of a chunk, or a run of messages outside of chunks.

    `offset` is where its first record starts in the file, bytes [begin, end) hold its content,
    which is of `size` bytes when unpacked.
    """

    offset: int
    begin: int
    end: int
    size: int
    crc: int = 0
    compression: str = ""


@dataclass
class Contents:
    """Everything in a file but its messages, and the segments that these lie in.

    `problem` says why the file is not complete: it ends early, or is damaged at a byte behind the
    last segment. None stands for a file that is whole as far as can be told without unpacking it.
    `indexed`: offsets of the chunks by the summary; `data_end`: where the summary starts;
    `head_end`: where the record is that vouches for all before it, 0 without one.
    """

    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    attachments: dict[str, bytes] = field(default_factory=dict)
    metadata: dict[str, dict[str, str]] = field(default_factory=dict)
    segments: list[Segment] = field(default_factory=list)
    message_counts: dict[int, int] | None = None
    problem: str | None = None
    indexed: set[int] = field(default_factory=set)
    data_end: int = 0
    head_end: int = 0

    def declare(self, opcode: int, body: Cursor) -> None:
        """Take in a Schema or Channel record; one that differs from its namesake is a LogError."""
        at = body.at
        if opcode == Op.SCHEMA:
            number, schema = body.schema()
            if self.schemas.setdefault(number, schema) != schema:
                raise LogError(f"byte {at}: schema {number} stands twice and differs")
        elif opcode == Op.CHANNEL:
            number, channel = body.channel()
            if self.channels.setdefault(number, channel) != channel:
                raise LogError(f"byte {at}: channel {number} stands twice and differs")


def scan(data: memoryview) -> Contents:
    """Walk the records of a file; what is cut off or damaged ends the walk, see `problem`.

    Raises:
        LogError: not an MCAP file, or the head that a levid log vouches for is damaged.
    """
    _check_magic(data)
    contents = Contents()
    try:
        for opcode, at, end in _walk(data):
            _take(contents, data, opcode, at, end)
    except LogError as error:
        contents.problem = str(error)
    _check_head(contents, data)
    return contents


class Unpacker:
    """Unpacks segments of a file, for one thread."""

    def __init__(self, data: memoryview) -> None:
        self._data = data
        self._zstd = zstandard.ZstdDecompressor()

    def __call__(self, segment: Segment) -> memoryview:
        """Return the content of a segment.

        Raises:
            LogError: it does not unpack to the size and CRC it should have.
        """
        where = f"byte {segment.offset}: chunk"
        packed = self._data[segment.begin : segment.end]
        if segment.size > MAX_CHUNK_BYTES:
            raise LogError(
                f"{where}: expected at most {MAX_CHUNK_BYTES} bytes, found {segment.size}"
            )
        try:
            raw = self._unpack(where, packed, segment)
        except (zstandard.ZstdError, RuntimeError, ValueError, MemoryError) as error:
            raise LogError(f"{where}: {segment.compression} data are damaged: {error}") from None
        if len(raw) != segment.size:
            raise LogError(f"{where}: expected {segment.size} bytes unpacked, found {len(raw)}")
        check_crc(where, raw, segment.crc)
        return raw

    def _unpack(self, where: str, packed: memoryview, segment: Segment) -> memoryview:
        size = segment.size
        if segment.compression == "":
            return packed
        # A frame's own idea of its size is what gets allocated: it must not be believed unseen.
        if segment.compression == "zstd":
            stated = zstandard.frame_content_size(packed)
            if stated not in (-1, size):
                raise ValueError(f"expected {size} bytes, the frame holds {stated}")
            return memoryview(self._zstd.decompress(packed, max_output_size=size))
        if segment.compression == "lz4":
            stated = lz4.frame.get_frame_info(packed)["content_size"]
            if stated not in (0, size) or size > _LZ4_BEST_RATIO * len(packed):
                raise ValueError(f"expected {size} bytes, the frame holds {stated or 'fewer'}")
            # One byte more than stated tells a frame that holds more, at no more cost than that.
            whole = lz4.frame.LZ4FrameDecompressor().decompress(packed, max_length=size + 1)
            return memoryview(whole)
        raise LogError(f"{where}: expected zstd, lz4 or none, found '{segment.compression}'")


def _check_magic(data: memoryview) -> None:
    head = bytes(data[: len(MAGIC)])
    if not head:
        raise LogError("expected an MCAP log, found an empty file")
    if head != MAGIC[: len(head)]:
        raise LogError(f"expected an MCAP file, starting with {MAGIC!r}, found {head!r}")
    if len(head) < len(MAGIC):
        raise LogError(f"the file is cut off at byte {len(head)}, within its first 8 bytes")


def _walk(data: memoryview) -> Iterator[tuple[int, int, int]]:
    """Yield opcode, begin and end of each record down to the footer; a LogError if cut off."""
    at = len(MAGIC)
    opcode = 0
    while opcode != Op.FOOTER:
        if len(data) - at < RECORD_HEAD.size:
            raise LogError(f"byte {at}: expected a record, found the end of the file")
        opcode, length = RECORD_HEAD.unpack_from(data, at)
        end = at + RECORD_HEAD.size + length
        if opcode == 0 or Op.DATA_END < opcode < 0x80:
            raise LogError(f"byte {at}: expected an MCAP record, found opcode 0x{opcode:02x}")
        if at == len(MAGIC) and opcode != Op.HEADER:
            raise LogError(f"byte {at}: expected the Header record, found opcode 0x{opcode:02x}")
        if end > len(data):
            kind = Op(opcode).name if opcode <= Op.DATA_END else "private"
            raise LogError(
                f"byte {at}: {kind} record of {length} bytes, the file ends {end - len(data)} early"
            )
        yield opcode, at, end
        at = end
    if data[at:] != MAGIC:
        raise LogError(f"byte {at}: expected the closing magic and then the end of the file")


def _take(contents: Contents, data: memoryview, opcode: int, at: int, end: int) -> None:
    """Take in the record at bytes [at, end); a LogError if it is damaged."""
    if opcode == Op.MESSAGE_INDEX:
        return
    if opcode == Op.CHUNK:
        contents.segments.append(_chunk(data, at, end))
        return
    body = Cursor(data, at + RECORD_HEAD.size, end)
    if opcode == Op.MESSAGE:
        _take_message(contents.segments, at, end)
    elif opcode == Op.ATTACHMENT:
        name, content = body.attachment()
        contents.attachments.setdefault(name, content)
    elif opcode == Op.METADATA:
        name = body.string()
        if name == _HEAD and name not in contents.metadata:
            contents.head_end = at
        contents.metadata.setdefault(name, body.string_map())
    elif opcode == Op.STATISTICS:
        # An empty map says that nobody counted.
        contents.message_counts = _message_counts(body) or None
    elif opcode == Op.CHUNK_INDEX:
        contents.indexed.add(body.integers("QQQ")[2])
    elif opcode == Op.DATA_END:
        contents.data_end = end
        if not all(segment.crc for segment in contents.segments):
            check_crc("the data section", data[:at], *body.integers("I"))
    elif opcode == Op.FOOTER:
        _check_summary(contents, data, at, body)
    else:
        contents.declare(opcode, body)


def _chunk(data: memoryview, at: int, end: int) -> Segment:
    """Return the segment in the Chunk record at bytes [at, end)."""
    begin = at + RECORD_HEAD.size
    found = end - begin
    if found >= CHUNK_HEAD.size:
        _, _, size, crc, length = CHUNK_HEAD.unpack_from(data, begin)
        begin += CHUNK_HEAD.size + length
        if (
            begin + 8 <= end
            and begin + 8 + int.from_bytes(data[begin : begin + 8], "little") == end
        ):
            compression = str(data[begin - length : begin], "utf-8", "replace")
            return Segment(at, begin + 8, end, size, crc, compression)
    raise LogError(f"byte {at}: the Chunk record of {found} bytes does not hold what it says")


def _take_message(segments: list[Segment], at: int, end: int) -> None:
    """Add the message record at bytes [at, end) to the run before it, or start a run."""
    last = segments[-1] if segments else None
    beside = last is not None and last.offset == last.begin and last.end == at
    if last is not None and beside and last.size < _RUN_BYTES:
        segments[-1] = Segment(last.offset, last.begin, end, end - last.begin)
    else:
        segments.append(Segment(at, at, end, end - at))


def _message_counts(body: Cursor) -> dict[int, int]:
    body.integers("QHIIIIQQ")
    (length,) = body.integers("I")
    return dict(struct.unpack("<HQ", body.take(10)) for _ in range(length // 10))


def _check_summary(contents: Contents, data: memoryview, at: int, body: Cursor) -> None:
    """Compare the summary with its CRC, and the chunks that were found with its index.

    A damaged opcode can make a chunk look like something to be skipped: then the log ends there.
    """
    start, _, crc = body.integers("QQI")
    if start == 0:
        return
    if start != contents.data_end:
        raise LogError(f"byte {at}: expected the summary at byte {contents.data_end}, not {start}")
    check_crc(f"byte {start}: summary", data[start : at + RECORD_HEAD.size + 16], crc)
    missing = contents.indexed - {segment.offset for segment in contents.segments}
    if missing:
        first = min(missing)
        contents.segments = [s for s in contents.segments if s.offset < first]
        raise LogError(f"byte {first}: expected a chunk, as the index says, found something else")


def _check_head(contents: Contents, data: memoryview) -> None:
    """Compare schema, channel, attachments and metadata with the CRC that levid gives them.

    Tools that copy a log record by record copy this one too, to another place: there it vouches for
    nothing.
    """
    stated = contents.metadata.get(_HEAD)
    if stated is None:
        return
    try:
        count, expected = int(stated["bytes"]), int(stated["crc32"], 16)
    except (KeyError, ValueError):
        raise LogError(f"metadata '{_HEAD}': expected bytes and crc32, found {stated}") from None
    if count != contents.head_end:
        return
    found = zlib.crc32(data[: max(count, 0)])
    if found != expected:
        raise LogError(
            f"bytes 0 to {count}, with schema and metadata, are damaged: "
            f"expected CRC {expected:08x}, found {found:08x}"
        )
