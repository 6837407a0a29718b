"""Write a log: MCAP whose chunks are numpy arrays, never inside the timed loop."""

from __future__ import annotations

import math
import os
import zlib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import TracebackType
from typing import BinaryIO, Self, cast

import numpy as np
import yaml
import zstandard
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    Chunk,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)
from mcap.well_known import MessageEncoding, Profile, SchemaEncoding
from mcap.writer import MCAP0_MAGIC
from numpy.typing import NDArray

from ..config.files.atomic_write import atomic_file, open_new
from ..config.version import __version__
from .errors import LogError, reason
from .mcap_scan import HEAD
from .message_array import MessageLayout
from .signals import ros2msg

FORMAT = "1"
SCHEMA_NAME, TOPIC = "levid/msg/Cycle", "/levid/cycle"
FIRST_CHUNK_ROWS, MAX_CHUNK_ROWS = 32, 8192
"""Rows of the first chunk. The next ones hold as many as all before them, up to the largest."""
# Measured on flights at 1 and 10 kHz: zstd at level -3 gives files 7 % smaller than lz4 and 10 %
# larger than zstd at level 1; it writes and reads as fast as lz4, and 1.5 and 2 times as fast as
# level 1. Without compression a file is 1.8 times as large and reads 1.4 to 1.5 times as fast.
COMPRESSION = "zstd"
ZSTD_LEVEL = -3

_ID = 1
"""Number of the one schema and of the one channel."""
_QOS = yaml.safe_dump(
    [
        {
            "history": 1,  # keep the last
            "depth": 10,
            "reliability": 1,  # reliable
            "durability": 2,  # volatile
            "deadline": {"sec": 0, "nsec": 0},
            "lifespan": {"sec": 0, "nsec": 0},
            "liveliness": 1,  # automatic
            "liveliness_lease_duration": {"sec": 0, "nsec": 0},
            "avoid_ros_namespace_conventions": False,
        }
    ],
    sort_keys=False,
)
"""What profile ros2 of MCAP's registry asks of a channel, so that rosbag2 plays a log; its numbers
are those of rmw, and durations of 0 its defaults."""


def record_bytes(*records: McapRecord) -> bytes:
    """Return the bytes of MCAP records."""
    builder = RecordBuilder()
    for record in records:
        record.write(builder)
    return bytes(builder.end())


BEGINNING = MCAP0_MAGIC + record_bytes(Header(Profile.ROS2, f"levid {__version__}"))
"""The first bytes of a log that this version of levid writes."""


class LogWriter:
    """Write one log file, a chunk at a time: the first is small, later ones hold 0.9 s of rows.

    A log that is cut off anywhere so has half of its rows at least, or less than the first chunk. A
    copy of the head follows the rows: `levid salvage` needs it where the head is damaged.
    Equal rows, times, metadata and attachments give equal bytes. Not safe for several threads.

    Args:
        path: the file, which must not exist.
        dtype: dtype of the rows: packed, little-endian, fields ordered by falling size.
        rate_hz: rows per second.
        metadata: pairs for the Metadata record "levid"; format and rate_hz are added.
        attachments: contents by name, written at the head so that a log cut off has them.
        units: units of fields that are not in SIGNALS, for the schema's comments.
        chunk_s: longest time in one chunk, which is the most that a crash of this process loses.
        schema: the ros2msg text of the schema, where it is known; units are then left out.
        file: an empty file that will be `path`; default: a new file at `path`, so that a crash
            leaves what was recorded.

    Raises:
        LogError: the file exists or cannot be written, or the dtype does not fit a ros2msg.
    """

    def __init__(
        self,
        path: Path,
        dtype: np.dtype[np.void],
        *,
        rate_hz: float,
        metadata: Mapping[str, str],
        attachments: Mapping[str, bytes],
        schema_name: str = SCHEMA_NAME,
        topic: str = TOPIC,
        units: Mapping[str, str] | None = None,
        chunk_s: float = 0.9,
        schema: str | None = None,
        file: BinaryIO | None = None,
    ) -> None:
        self.path = Path(path)
        self.dtype = dtype
        text = (ros2msg(dtype, units) if schema is None else schema).encode()
        self._schema = Schema(id=_ID, name=schema_name, encoding=SchemaEncoding.ROS2, data=text)
        self._channel = Channel(
            id=_ID,
            schema_id=_ID,
            topic=topic,
            message_encoding=MessageEncoding.CDR,
            metadata={"offered_qos_profiles": _QOS},
        )
        self._names = dtype.names or ()
        if dtype.itemsize != sum(dtype[name].itemsize for name in self._names):
            raise LogError(f"{path}: expected a packed dtype, fields ordered by falling size")
        if not (0 < rate_hz < math.inf and chunk_s > 0):
            raise LogError(f"{path}: expected a positive rate, found {rate_hz} Hz")
        rows = int(max(1, min(MAX_CHUNK_ROWS, rate_hz * chunk_s)))
        self._buffer = MessageLayout(_ID, dtype).zeros(rows)
        # Opaque items of the same size: numpy then copies bytes, not field by field.
        self._payload = self._buffer["payload"].view(f"V{dtype.itemsize}")[:, 0]
        self._filled = 0
        self._room = min(FIRST_CHUNK_ROWS, rows)
        self._count = 0
        self._start_ns, self._end_ns = 0, 0
        self._compressor = zstandard.ZstdCompressor(level=ZSTD_LEVEL)
        self._chunk_indexes: list[ChunkIndex] = []
        self._attachment_indexes: list[AttachmentIndex] = []
        self._metadata_indexes: list[MetadataIndex] = []
        self._crc, self._at = 0, 0
        try:
            self._file = _new_file(self.path) if file is None else file
        except FileExistsError:
            raise _exists(path) from None
        except OSError as error:
            raise LogError(f"{path}: cannot be created: {error.strerror}") from None
        facts = {"format": FORMAT, **metadata, "rate_hz": repr(float(rate_hz))}
        try:
            self._put_head(facts, attachments)
        except BaseException:
            # The file holds no rows yet and would block the next attempt.
            self._file.close()
            if file is None:
                self.path.unlink(missing_ok=True)
            raise

    def write(self, rows: NDArray[np.void], log_time_ns: NDArray[np.uint64]) -> None:
        """Append rows of this log's dtype, (n,), and their times in ns, (n,).

        Raises:
            LogError: the rows do not fit, the log is closed, or the disk rejects the data (then the
                log ends with its last whole chunk).
        """
        if rows.dtype != self.dtype:
            raise LogError(
                f"{self.path}: expected rows of {self.dtype.itemsize} bytes with the log's "
                f"{len(self._names)} fields, found {rows.dtype.itemsize} bytes and "
                f"{len(rows.dtype.names or ())} fields, or their order or types differ"
            )
        if rows.ndim != 1 or log_time_ns.shape != rows.shape:
            raise LogError(
                f"{self.path}: expected rows (n,) and times (n,), "
                f"found {rows.shape} and {log_time_ns.shape}"
            )
        if self._file.closed:
            raise LogError(f"{self.path}: the log is closed")
        done = 0
        while done < rows.size:
            count = min(rows.size - done, self._room - self._filled)
            self._fill(rows[done : done + count], log_time_ns[done : done + count])
            done += count
            if self._filled == self._room:
                self._put_chunk()

    @property
    def buffered(self) -> int:
        """Number of rows in the unfinished chunk, not written to the file yet."""
        return self._filled

    @property
    def size(self) -> int:
        """Bytes written to the file so far."""
        return self._at

    def fileno(self) -> int:
        """Return the file descriptor, for fsync; raise ValueError if the log is closed."""
        return self._file.fileno()

    def close(self, *, whole: bool = True) -> None:
        """Write the last chunk, summary and footer; a second call does nothing.

        With `whole` false, summary and footer are left out: readers say that the log was cut off.
        """
        if self._file.closed:
            return
        if self._filled:
            self._put_chunk()
        if not whole:
            self._file.close()
            return
        self._put_attachment(HEAD, self._head)
        self._put(record_bytes(DataEnd(self._crc)))
        self._put(self._summary(self._at) + MCAP0_MAGIC)
        self._file.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def _put_head(self, facts: Mapping[str, str], attachments: Mapping[str, bytes]) -> None:
        head = [self._put(BEGINNING + record_bytes(self._schema, self._channel))]
        head += [self._put_attachment(name, data) for name, data in attachments.items()]
        head.append(self._put_metadata("levid", facts))
        # The head has no CRC of its own in MCAP, and a log cut off lacks the CRC of all data.
        stated = {"bytes": str(self._at), "crc32": f"{self._crc:08x}"}
        head.append(self._put_metadata(HEAD, stated))
        self._head = b"".join(head)

    def _put_attachment(self, name: str, data: bytes) -> bytes:
        # The times are 0: not known, and equal input gives equal bytes.
        media_type = _media_type(name)
        record = record_bytes(Attachment(0, 0, name, media_type, data))
        index = AttachmentIndex(self._at, len(record), 0, 0, len(data), name, media_type)
        self._attachment_indexes.append(index)
        return self._put(record)

    def _put_metadata(self, name: str, mapping: Mapping[str, str]) -> bytes:
        # A file name may hold bytes that are not text: they become '?'.
        text = {key: value.encode("utf-8", "replace").decode() for key, value in mapping.items()}
        record = record_bytes(Metadata(name, text))
        self._metadata_indexes.append(MetadataIndex(self._at, len(record), name))
        return self._put(record)

    def _fill(self, rows: NDArray[np.void], log_time_ns: NDArray[np.uint64]) -> None:
        place = slice(self._filled, self._filled + rows.size)
        part = self._buffer[place]
        first = self._count + self._filled
        counted = np.arange(first, first + rows.size, dtype=np.uint64)
        number = rows["cycle"] if "cycle" in self._names else counted
        part["sequence"] = number & np.uint64(0xFFFFFFFF)
        part["log_time"] = log_time_ns
        part["publish_time"] = log_time_ns
        self._payload[place] = rows.view(self._payload.dtype)
        self._filled += rows.size

    def _put_chunk(self) -> None:
        messages = self._buffer[: self._filled]
        raw = messages.view(np.uint8)
        times = messages["log_time"]
        start, end = int(times.min()), int(times.max())
        packed = self._compressor.compress(raw.data)
        builder = RecordBuilder()
        Chunk(
            compression=COMPRESSION,
            data=packed,
            message_start_time=start,
            message_end_time=end,
            uncompressed_crc=zlib.crc32(raw.data),
            uncompressed_size=raw.size,
        ).write(builder)
        length = builder.count
        _write_message_index(builder, times, messages.itemsize)
        self._chunk_indexes.append(
            ChunkIndex(
                chunk_start_offset=self._at,
                chunk_length=length,
                compression=COMPRESSION,
                compressed_size=len(packed),
                uncompressed_size=raw.size,
                message_start_time=start,
                message_end_time=end,
                message_index_offsets={_ID: self._at + length},
                message_index_length=builder.count - length,
            )
        )
        # One write for both: after a crash the file holds a whole chunk or one that is cut off.
        self._put(builder.end())
        self._start_ns = min(start, self._start_ns) if self._count else start
        self._end_ns = max(end, self._end_ns)
        self._count += self._filled
        self._filled = 0
        self._room = min(max(self._room, self._count), self._buffer.size)

    def _summary(self, summary_start: int) -> bytes:
        """Return summary, summary offsets and footer for a summary that starts at that byte."""
        statistics = Statistics(
            attachment_count=len(self._attachment_indexes),
            channel_count=1,
            channel_message_counts={_ID: self._count},
            chunk_count=len(self._chunk_indexes),
            message_count=self._count,
            message_end_time=self._end_ns,
            message_start_time=self._start_ns,
            metadata_count=len(self._metadata_indexes),
            schema_count=1,
        )
        groups: list[Sequence[McapRecord]] = [
            [self._schema],
            [self._channel],
            [statistics],
            self._chunk_indexes,
            self._attachment_indexes,
            self._metadata_indexes,
        ]
        summary, offsets = b"", []
        for part in (record_bytes(*group) for group in groups if group):
            opcode = part[0]
            offsets.append(SummaryOffset(opcode, summary_start + len(summary), len(part)))
            summary += part
        offset_start = summary_start + len(summary)
        summary += record_bytes(*offsets)
        # The CRC covers the footer as well, up to the CRC itself, its last 4 bytes.
        before_crc = record_bytes(Footer(summary_start, offset_start, 0))[:-4]
        crc = zlib.crc32(summary + before_crc)
        return summary + record_bytes(Footer(summary_start, offset_start, crc))

    def _put(self, data: bytes) -> bytes:
        try:
            view = memoryview(data)
            while view:
                view = view[self._file.write(view) :]
        except OSError as error:
            self._file.close()
            raise LogError(f"{self.path}: cannot be written: {reason(error)}") from None
        self._crc = zlib.crc32(data, self._crc)
        self._at += len(data)
        return data


@contextmanager
def new_log_file(path: Path) -> Iterator[BinaryIO]:
    """Open a file for a LogWriter that becomes `path` when the `with` body has completed it.

    Raises:
        LogError: `path` exists.
        OSError: it cannot be written.
    """
    try:
        with atomic_file(path, replace=False) as file:
            yield file
    except FileExistsError:
        raise _exists(path) from None


def _exists(path: Path) -> LogError:
    return LogError(f"{path}: exists; a log is never written over another")


def _new_file(path: Path) -> BinaryIO:
    return cast("BinaryIO", os.fdopen(open_new(path), "wb", buffering=0))


def _write_message_index(
    builder: RecordBuilder, times: NDArray[np.uint64], message_bytes: int
) -> None:
    """Write the index of a chunk that holds nothing but messages of one size.

    mcap's MessageIndex writes entry by entry, which takes a quarter of the time of all writing.
    """
    entries = np.empty((times.size, 2), "<u8")  # time and offset of each message
    entries[:, 0] = times
    entries[:, 1] = np.arange(times.size) * message_bytes
    builder.start_record(Opcode.MESSAGE_INDEX)
    builder.write2(_ID)
    builder.write4(entries.nbytes)
    builder.write(entries.tobytes())
    builder.finish_record()


def _media_type(name: str) -> str:
    types = {".yaml": "application/yaml", ".json": "application/json"}
    return types.get(Path(name).suffix, "application/octet-stream")
