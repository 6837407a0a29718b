"""Scan an MCAP file, whole, cut off or damaged, for its chunks and their description."""

from __future__ import annotations

import contextlib
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from struct import Struct
from typing import Any, cast

import lz4.frame
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import EndOfFile
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    Channel,
    Chunk,
    ChunkIndex,
    DataEnd,
    Footer,
    Metadata,
    Schema,
    Statistics,
)
from mcap.writer import MCAP0_MAGIC

from ..config.escaping import one_line
from .errors import LogError
from .unpacked_size import most_unpacked_bytes, too_much

RECORD_HEAD = Struct("<BQ")  # opcode, length of the rest
MESSAGE_HEAD_BYTES = RECORD_HEAD.size + 22
"""Bytes of a message before its data: record head, channel, sequence, two times."""
# A corrupt size must not allocate gigabytes; common writers make chunks of 1 to 16 MiB.
MAX_CHUNK_BYTES = 256 << 20
_LZ4_BEST_RATIO = 255
_REPORTED_BYTES = 8 << 20
_RUN_BYTES = 16 << 20
"""Size at which a run of messages outside of chunks ends, so that threads can share the runs."""
HEAD = "levid-head"
"""Name of the metadata with size and CRC of a levid log's head, and of the attachment behind its
rows that repeats the head."""

# mcap's StreamReader parses each entry of a MessageIndex in Python as well: on flights that takes
# twice as long as read_log does altogether.
_PARSERS: dict[int, Callable[[ReadDataStream], Any]] = {
    Opcode.SCHEMA: Schema.read,
    Opcode.CHANNEL: Channel.read,
    Opcode.CHUNK: Chunk.read,
    Opcode.CHUNK_INDEX: ChunkIndex.read,
    Opcode.ATTACHMENT: Attachment.read,
    Opcode.STATISTICS: Statistics.read,
    Opcode.METADATA: Metadata.read,
    Opcode.DATA_END: DataEnd.read,
    Opcode.FOOTER: Footer.read,
}


@dataclass
class Contents:
    """Everything in a file except its messages, and the chunks that hold the messages.

    chunks: by offset in the file; data is a view of the file, still compressed. A run of messages
    outside of chunks is one uncompressed chunk. message_counts: by channel, from the statistics.
    problem: why the file is incomplete (it ends early, or is damaged after the last of `chunks`);
    None if the scan finds no damage. The scan decompresses no chunk of a log with a head.
    """

    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    attachments: dict[str, bytes] = field(default_factory=dict)
    metadata: dict[str, dict[str, str]] = field(default_factory=dict)
    chunks: dict[int, Chunk] = field(default_factory=dict)
    message_counts: dict[int, int] | None = None
    problem: str | None = None

    @property
    def facts(self) -> dict[str, str]:
        """The pairs of the metadata record `levid`, each text on one line that prints."""
        pairs = self.metadata.get("levid", {})
        return {one_line(key): one_line(value) for key, value in pairs.items()}

    def declare(self, record: Schema | Channel, where: str) -> None:
        """Add a schema or channel; raise LogError if its number has another meaning already."""
        known: dict[int, Any] = self.schemas if isinstance(record, Schema) else self.channels
        if known.setdefault(record.id, record) != record:
            kind = type(record).__name__.lower()
            raise LogError(f"{where}: expected one {kind} {record.id}, found two that differ")


def scan(data: memoryview, passed: Callable[[int], None] | None = None) -> Contents:
    """Walk through the records of a file up to its end, or to the first damage: see `problem`.

    passed: called now and then with the number of bytes that the walk has passed.

    Raises:
        LogError: not an MCAP file, the head of a levid log is damaged, or the chunks state that
            they hold much more than a file of this size does.
    """
    _check_magic(data)
    walk = _Scan(data, passed)
    try:
        walk.run()
    except LogError as error:
        walk.contents.problem = str(error)
    try:
        walk.check_head()
    except LogError as error:
        raise LogError(f"{error}; `levid salvage` recovers the rows") from None
    _check_unpacked(walk.contents, len(data))
    if not walk.contents.channels:
        _declare_from_chunks(walk.contents)
    return walk.contents


def checked_head(data: memoryview) -> Contents | None:
    """Return the head of a levid log if its CRC confirms it, without any chunk; else None."""
    walk = _Scan(data)
    try:
        _check_magic(data)
        with contextlib.suppress(LogError):  # damage behind the head
            walk.run()
        confirmed = walk.check_head()
    except LogError:
        return None
    walk.contents.chunks = {}
    return walk.contents if confirmed else None


def records(data: memoryview, at: int = 0, where: str = "") -> Iterator[tuple[int, int, int]]:
    """Yield opcode, first byte and end of each record; raise LogError if the last is cut off."""
    while at < len(data):
        end = at + RECORD_HEAD.size
        if end <= len(data):
            opcode, length = RECORD_HEAD.unpack_from(data, at)
            end += length
        if end > len(data):
            raise LogError(
                f"{where}byte {at}: expected a record of {end - at} bytes, found {len(data) - at}"
            )
        if opcode == Opcode.MESSAGE and end - at < MESSAGE_HEAD_BYTES:
            raise LogError(
                f"{where}byte {at}: expected a message of at least {MESSAGE_HEAD_BYTES} bytes, "
                f"found {end - at}"
            )
        yield opcode, at, end
        at = end


class Decompressor:
    """Decompress chunks, for one thread: a new zstd context for each chunk takes 6 % longer.

    mcap's get_chunk_data_stream lets a damaged chunk allocate any size that its data claim.
    """

    def __init__(self) -> None:
        self._zstd = zstandard.ZstdDecompressor()

    def __call__(self, offset: int, chunk: Chunk) -> memoryview:
        """Return the records in the chunk at `offset` of the file, at most MAX_CHUNK_BYTES.

        Raises:
            LogError: the data are damaged: they do not have the size and CRC that the chunk states.
        """
        where, size = f"byte {offset}: chunk", chunk.uncompressed_size
        if size > MAX_CHUNK_BYTES:
            raise LogError(f"{where}: expected at most {MAX_CHUNK_BYTES} bytes, found {size}")
        try:
            raw = self._decompressed(memoryview(chunk.data), chunk.compression, size)
        except (zstandard.ZstdError, RuntimeError, ValueError, MemoryError) as error:
            raise LogError(f"{where}: damaged {chunk.compression} data: {error}") from None
        if len(raw) != size:
            raise LogError(f"{where}: expected {size} bytes when decompressed, found {len(raw)}")
        _check_crc(where, raw, chunk.uncompressed_crc)
        return raw

    def _decompressed(self, packed: memoryview, compression: str, size: int) -> memoryview:
        # Both libraries allocate the size that the data state, so that size is compared first.
        if compression == "":
            return packed
        if compression == "zstd":
            stated = zstandard.frame_content_size(packed)
            if stated not in (-1, size):
                raise ValueError(f"expected {size} bytes, found {stated} in the zstd header")
            return memoryview(self._zstd.decompress(packed, max_output_size=size))
        if compression == "lz4":
            stated = lz4.frame.get_frame_info(packed)["content_size"]
            if stated not in (0, size) or size > _LZ4_BEST_RATIO * len(packed):
                raise ValueError(
                    f"expected {size} bytes, found {stated or 'fewer'} in the lz4 data"
                )
            # One byte more than `size` detects data that hold more.
            lz4_frame = lz4.frame.LZ4FrameDecompressor()
            return memoryview(lz4_frame.decompress(packed, max_length=size + 1))
        raise ValueError("expected zstd, lz4 or no compression")


class _Scan:
    """State of one walk through a file."""

    def __init__(self, data: memoryview, passed: Callable[[int], None] | None = None) -> None:
        self.contents = Contents()
        self._data = data
        self._passed = passed or (lambda _end: None)
        self._indexed: set[int] = set()  # offsets of the chunks, as the summary states them
        self._head_end = 0  # offset of the record that holds the CRC of everything before it
        self._data_end = 0

    def run(self) -> None:
        """Read all records; raise LogError at the first that is damaged, or if there is no end."""
        data, start = self._data, len(MCAP0_MAGIC)
        run, run_begin, run_end = Chunk("", b"", 0, 0, 0, 0), 0, 0
        end = reported = start
        for opcode, at, end in records(data, start):
            if end - reported > _REPORTED_BYTES:
                reported = end
                self._passed(end)
            if opcode == 0 or Opcode.DATA_END < opcode < 0x80:
                raise LogError(f"byte {at}: expected an MCAP record, found opcode 0x{opcode:02x}")
            if at == start and opcode != Opcode.HEADER:
                raise LogError(
                    f"byte {at}: expected the Header record, found opcode 0x{opcode:02x}"
                )
            if opcode == Opcode.MESSAGE:
                if at != run_end or run.uncompressed_size >= _RUN_BYTES:
                    run_begin, run = at, Chunk("", b"", 0, 0, 0, 0)
                    self.contents.chunks[at] = run
                run_end, run.uncompressed_size = end, end - run_begin
                run.data = cast("bytes", data[run_begin:end])
            elif opcode in _PARSERS:
                self._take(parsed(data, opcode, at, end), at, end)
            if opcode == Opcode.FOOTER:
                break
        else:
            raise LogError(f"byte {end}: expected a record, found the end of the file")
        if data[end:] != MCAP0_MAGIC:
            raise LogError(f"byte {end}: expected the closing magic and then the end of the file")

    def check_head(self) -> bool:
        """Compare schema, channel, attachments and metadata with the CRC that levid writes.

        Return whether the CRC confirms them. Tools that copy a log record by record copy this CRC
        to another offset: then it says nothing.
        """
        stated = self.contents.metadata.get(HEAD)
        if stated is None:
            return False
        try:
            count, expected = int(stated["bytes"]), int(stated["crc32"], 16)
        except (KeyError, ValueError):
            raise LogError(
                f"metadata '{HEAD}': expected the keys 'bytes' and 'crc32', found {stated}"
            ) from None
        if count != self._head_end:
            return False
        _check_crc(f"bytes 0 to {count}, with schema and metadata", self._data[:count], expected)
        return True

    def _take(self, record: object, at: int, end: int) -> None:
        contents = self.contents
        match record:
            case Chunk():
                contents.chunks[at] = record
            case ChunkIndex():
                self._indexed.add(record.chunk_start_offset)
            case Schema() | Channel():
                contents.declare(record, f"byte {at}")
            case Attachment():
                body, crc = self._data[at + RECORD_HEAD.size : end - 4], self._data[end - 4 : end]
                where = f"byte {at}: attachment '{record.name}'"
                _check_crc(where, body, int.from_bytes(crc, "little"))
                if record.name != HEAD:
                    contents.attachments.setdefault(record.name, bytes(record.data))
            case Metadata():
                if record.name == HEAD and HEAD not in contents.metadata:
                    self._head_end = at
                contents.metadata.setdefault(record.name, record.metadata)
            case Statistics():
                contents.message_counts = record.channel_message_counts or None
            case DataEnd():
                self._data_end = end
                if not all(chunk.uncompressed_crc for chunk in contents.chunks.values()):
                    _check_crc("the data section", self._data[:at], record.data_section_crc)
            case Footer():
                self._check_summary(record, at)

    def _check_summary(self, footer: Footer, at: int) -> None:
        """Compare the summary with its CRC, and the chunks of the file with its index.

        A chunk whose opcode is damaged can look like a record to skip: then the log ends there.
        """
        start, chunks = footer.summary_start, self.contents.chunks
        if start == 0:
            return
        if start != self._data_end:
            raise LogError(f"byte {at}: expected the summary at byte {self._data_end}, not {start}")
        summary = self._data[start : at + RECORD_HEAD.size + 16]
        _check_crc(f"byte {start}: summary", summary, footer.summary_crc)
        if missing := self._indexed - chunks.keys():
            first = min(missing)
            self.contents.chunks = {at: chunk for at, chunk in chunks.items() if at < first}
            raise LogError(
                f"byte {first}: expected a chunk, as the index states, found another record"
            )


class _RecordStream(ReadDataStream):
    """Give mcap the bytes of one record: no copy, and never a byte beyond the record."""

    def __init__(self, data: memoryview, begin: int, end: int) -> None:
        self._data = cast("bytes", data)  # mcap reads from either
        self._begin, self._at, self._end = begin, begin, end

    @property
    def count(self) -> int:
        return self._at - self._begin

    def read(self, length: int) -> bytes:
        at = self._at
        self._at += length
        if self._at > self._end:
            raise EndOfFile
        return self._data[at : self._at]


def parsed(data: memoryview, opcode: int, at: int, end: int, where: str = "") -> Any:
    """Return the record in bytes [at, end) as mcap parses it; raise LogError if it is damaged."""
    begin = at + RECORD_HEAD.size
    stream = _RecordStream(data, begin, end)
    try:
        record = _PARSERS[opcode](stream)
        if opcode == Opcode.CHUNK and stream.count != end - begin:
            raise EndOfFile  # a wrong length may have swallowed the chunks that follow
    except (EndOfFile, UnicodeDecodeError):
        raise LogError(
            f"{where}byte {at}: damaged {Opcode(opcode).name} record: a length or text is wrong"
        ) from None
    return record


def _check_unpacked(contents: Contents, file_bytes: int) -> None:
    # A chunk that states too large a size is damaged, and gets no memory.
    sizes = (chunk.uncompressed_size for chunk in contents.chunks.values())
    unpacked = sum(size for size in sizes if size <= MAX_CHUNK_BYTES)
    if unpacked > most_unpacked_bytes(file_bytes):
        raise LogError(too_much(file_bytes, unpacked))


def _declare_from_chunks(contents: Contents) -> None:
    """Find the channels of a log that declares them only among its messages."""
    decompress = Decompressor()
    for offset, chunk in contents.chunks.items():
        where = f"byte {offset}: chunk: "
        try:
            raw = decompress(offset, chunk)
            for opcode, at, end in records(raw, where=where):
                if opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                    record = parsed(raw, opcode, at, end, where)
                    contents.declare(record, f"{where}byte {at}")
        except LogError as error:
            contents.problem = str(error)
            return


def _check_magic(data: memoryview) -> None:
    head = bytes(data[: len(MCAP0_MAGIC)])
    if not head:
        raise LogError("expected an MCAP log, found an empty file")
    if head != MCAP0_MAGIC[: len(head)]:
        raise LogError(
            "expected an MCAP log, found another kind of file; `levid import` converts CSV, text, "
            "NPZ and MAT files"
        )
    if len(head) < len(MCAP0_MAGIC):
        raise LogError(f"the file is cut off at byte {len(head)}, within its first 8 bytes")


def _check_crc(where: str, data: memoryview, expected: int) -> None:
    """Raise LogError unless `data` has the CRC-32 `expected`; 0 means that none is stated."""
    if expected and (found := zlib.crc32(data)) != expected:
        raise LogError(f"{where}: damaged: expected CRC {expected:08x}, found {found:08x}")
