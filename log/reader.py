"""Reads a log into arrays: a chunk of fixed-size records is one strided array, not a loop."""

from __future__ import annotations

import difflib
import math
import mmap
import os
from collections.abc import Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .container import MAX_CHUNK_BYTES, Contents, Segment, Unpacker, scan
from .errors import LogError
from .mcap_format import MESSAGE_HEAD, RECORD_HEAD, Channel, Cursor, Op
from .signals import SIGNALS, dtype_from_ros2msg

_HEAD = RECORD_HEAD.size + MESSAGE_HEAD.size
_CDR = 4
_LOG_TIME = RECORD_HEAD.size + 6
# Some CDR writers round the payload up to a multiple of 4 or 8 bytes.
_MAX_PADDING = 7


@dataclass(frozen=True)
class Log:
    """One log in arrays.

    rows: structured array (n,), the fields as the schema names them, in the order of the file.
    log_time_ns: (n,). rate_hz: as the metadata say, else from the log times. metadata: pairs of the
    record "levid". attachments: contents by name. complete: False for a log that was cut off or
    damaged, whose rows end with its last whole chunk; `problem` then says where and why.
    """

    path: Path
    rows: NDArray[np.void]
    log_time_ns: NDArray[np.uint64]
    rate_hz: float
    schema_name: str
    metadata: dict[str, str]
    attachments: dict[str, bytes]
    complete: bool
    problem: str | None

    def field(self, name: str) -> NDArray[Any]:
        """Return one field, (n,) or (n, length); LogError with close names if there is none."""
        names = self.rows.dtype.names or ()
        if name not in names:
            close = difflib.get_close_matches(name, names, n=3) or names
            raise LogError(f"{self.path}: no field '{name}'; there is {', '.join(close)}")
        return self.rows[name]


def read_log(path: Path | str) -> Log:
    """Read a log of levid, or of anyone who writes fixed-size CDR messages to MCAP.

    Of several channels it takes the one that carries signals of levid, or the only one whose schema
    has a fixed size.

    Raises:
        LogError: no such file, not MCAP, no such channel, no messages, damaged before the first
            whole chunk, or larger when unpacked than this computer's memory; with file, byte, what
            was expected and what was found.
    """
    path = Path(path)
    try:
        return _read(path, _mapped(path))
    except LogError as error:
        raise LogError(f"{path}: {error}") from None


@dataclass(frozen=True)
class _Stream:
    """The messages to be read: channel, layout, and the first two bytes of their CDR."""

    channel: int
    dtype: np.dtype[np.void]
    cdr: bytes

    @property
    def least(self) -> int:
        """Bytes of the shortest message record that holds the dtype."""
        return _HEAD + _CDR + self.dtype.itemsize


def _mapped(path: Path) -> memoryview:
    try:
        if path.is_dir():
            raise LogError("expected a log, found a folder: give the logs in it, as FOLDER/*.mcap")
        if path.exists() and not path.is_file():
            raise LogError("expected a file, found something else")
        with path.open("rb") as file:
            if os.fstat(file.fileno()).st_size == 0:
                return memoryview(b"")
            return memoryview(mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ))
    except OSError as error:
        raise LogError(f"cannot be read: {error.strerror or error}") from None


def _read(path: Path, data: memoryview) -> Log:
    contents = scan(data)
    if not contents.channels:
        _declare_from_chunks(data, contents)
    channel, dtype = _choose_channel(contents)
    cdr, unpacked = _first_cdr_header(data, contents, channel)
    stream = _Stream(channel, dtype if cdr == b"\x00\x01" else dtype.newbyteorder(">"), cdr)
    rows, times, problem = _read_rows(data, contents.segments, stream, unpacked)
    problem = problem or contents.problem
    if problem is None and contents.message_counts is not None:
        stated = contents.message_counts.get(channel, 0)
        if stated != rows.size:
            problem = f"expected {stated} messages, as the statistics say, found {rows.size}"
    if not rows.size:
        raise LogError(problem or f"no messages on {contents.channels[channel].topic}")
    metadata = contents.metadata.get("levid", {})
    return Log(
        path=path,
        rows=rows if rows.dtype == dtype else rows.astype(dtype),
        log_time_ns=times,
        rate_hz=_rate_hz(metadata, times),
        schema_name=contents.schemas[contents.channels[channel].schema].name,
        metadata=metadata,
        attachments=contents.attachments,
        complete=problem is None,
        problem=problem,
    )


def _choose_channel(contents: Contents) -> tuple[int, np.dtype[np.void]]:
    """Return number and dtype of the channel to be read."""
    fixed: dict[int, np.dtype[np.void]] = {}
    reasons = []
    for number, channel in contents.channels.items():
        try:
            fixed[number] = _channel_dtype(contents, channel)
        except LogError as error:
            reasons.append(f"{channel.topic}: {error}")
    ours = {s.name for s in SIGNALS}
    known = {n: d for n, d in fixed.items() if ours & set(d.names or ())}
    candidates = known if known else fixed
    if len(candidates) == 1:
        return next(iter(candidates.items()))
    if not contents.channels:
        raise LogError(contents.problem or "expected a channel with messages, found none")
    if not candidates:
        raise LogError(f"no channel of fixed-size messages: {'; '.join(reasons)}")
    topics = ", ".join(contents.channels[number].topic for number in candidates)
    raise LogError(f"expected one channel of fixed-size messages, found {topics}")


def _channel_dtype(contents: Contents, channel: Channel) -> np.dtype[np.void]:
    schema = contents.schemas.get(channel.schema)
    found = f"{channel.encoding} with {schema.encoding if schema else 'no schema'}"
    if schema is None or found != "cdr with ros2msg":
        raise LogError(f"expected cdr with ros2msg, found {found}")
    return dtype_from_ros2msg(schema.data.decode("utf-8", errors="replace"))


def _declare_from_chunks(data: memoryview, contents: Contents) -> None:
    """Find the channels of a log that names them nowhere but between its messages."""
    unpack = Unpacker(data)
    for segment in contents.segments:
        try:
            raw = unpack(segment)
            for opcode, begin, end in _records(raw, segment):
                contents.declare(opcode, Cursor(raw, begin, end))
        except LogError as error:
            contents.problem = str(error)
            return


def _first_cdr_header(
    data: memoryview, contents: Contents, channel: int
) -> tuple[bytes, dict[int, memoryview]]:
    """Return the first two bytes of the first message, which tell its byte order.

    Also the content of the segment it was found in, by its number, to spare unpacking it again.
    """
    unpack = Unpacker(data)
    for i, segment in enumerate(contents.segments):
        raw = unpack(segment)
        for opcode, begin, end in _records(raw, segment):
            if opcode == Op.MESSAGE and _channel_of(raw, begin) == channel:
                cdr = bytes(raw[begin + MESSAGE_HEAD.size : end][:2])
                if cdr not in (b"\x00\x01", b"\x00\x00"):
                    raise LogError(
                        f"byte {segment.offset}: expected messages that start with 00 01 (CDR, "
                        f"little endian) or 00 00 (big endian), found {cdr.hex(' ') or 'nothing'}"
                    )
                return cdr, {i: raw}
    topic = contents.channels[channel].topic
    raise LogError(contents.problem or f"expected messages on {topic}, found none")


def _read_rows(
    data: memoryview,
    segments: list[Segment],
    stream: _Stream,
    unpacked: Mapping[int, memoryview],
) -> tuple[NDArray[np.void], NDArray[np.uint64], str | None]:
    """Return rows, times, and what is wrong with the first segment that could not be read."""
    # A segment that claims too much will fail to unpack; no room is kept for it. All of them
    # together may claim too much as well: a few zeros pack a chunk of any size.
    claimed, memory = sum(s.size for s in segments if s.size <= MAX_CHUNK_BYTES), memory_bytes()
    if claimed > memory:
        raise LogError(
            f"expected a log that this computer's memory of {_gib(memory)} holds, found one of "
            f"{_gib(claimed)} when unpacked ({_gib(len(data))} as it is)"
        )
    room = [s.size // stream.least if s.size <= MAX_CHUNK_BYTES else 0 for s in segments]
    starts = np.concatenate([[0], np.cumsum(room)]).tolist()
    try:
        rows = np.empty(starts[-1], stream.dtype)
        times = np.empty(starts[-1], np.uint64)
    except MemoryError:
        raise LogError(f"not enough memory for {starts[-1]} messages") from None

    # As bytes: numpy copies these without holding the interpreter's lock, however short the chunk.
    payloads = rows.view(np.uint8).reshape(-1, stream.dtype.itemsize)

    def read(part: range) -> list[int | LogError]:
        unpack = Unpacker(data)
        counts: list[int | LogError] = []
        for i in part:
            place = slice(starts[i], starts[i + 1])
            try:
                raw = unpacked[i] if i in unpacked else unpack(segments[i])
                counts.append(_fill(raw, segments[i], stream, payloads[place], times[place]))
            except LogError as error:
                return [*counts, error]
        return counts

    # Unpacking, CRC and copying all release the interpreter's lock; many segments to a task, since
    # handing over a task takes as long as reading a small one.
    workers = min(4, os.cpu_count() or 1)
    step = -(-len(segments) // (4 * workers)) or 1
    parts = [range(i, min(i + step, len(segments))) for i in range(0, len(segments), step)]
    with ThreadPoolExecutor(workers) as pool:
        counts = [count for part in pool.map(read, parts) for count in part]
    filled = 0
    for start, count in zip(starts, counts, strict=False):
        if isinstance(count, LogError):
            return rows[:filled], times[:filled], str(count)
        if start != filled:  # other channels left gaps
            rows[filled : filled + count] = rows[start : start + count]
            times[filled : filled + count] = times[start : start + count]
        filled += count
    return rows[:filled], times[:filled], None


def _fill(
    raw: memoryview,
    segment: Segment,
    stream: _Stream,
    rows: NDArray[np.uint8],
    times: NDArray[np.uint64],
) -> int:
    """Fill rows and times from the messages of one segment; return how many there were."""
    place = _uniform(raw, stream) or _scattered(raw, segment, stream)
    count = len(place)
    if not count:
        return 0
    size = stream.dtype.itemsize
    if isinstance(place, range):
        heads = np.ndarray((count,), "<u8", raw, place.start + _LOG_TIME, (place.step,))
        bodies = np.ndarray((count, size), "u1", raw, place.start + _HEAD + _CDR, (place.step, 1))
    else:
        # Windows at every byte, of which only those at the messages are looked at.
        heads = np.ndarray((len(raw) - 7,), "<u8", raw, 0, (1,))[place + _LOG_TIME]
        windows = np.ndarray((len(raw) - size + 1, size), "u1", raw, 0, (1, 1))
        bodies = windows[place + _HEAD + _CDR]
    times[:count] = heads
    rows[:count] = bodies
    return count


def _uniform(raw: memoryview, stream: _Stream) -> range | None:
    """Return the places of the message records if they are all alike, and alone but for a head."""
    begin = 0
    while len(raw) - begin >= _HEAD and raw[begin] in (Op.SCHEMA, Op.CHANNEL):
        begin += RECORD_HEAD.size + RECORD_HEAD.unpack_from(raw, begin)[1]
    if len(raw) - begin < stream.least:
        return None
    stride = RECORD_HEAD.size + RECORD_HEAD.unpack_from(raw, begin)[1]
    count, rest = divmod(len(raw) - begin, stride)
    if rest or not 0 <= stride - stream.least <= _MAX_PADDING:
        return None
    # Opcode, length and channel lie together; so they are compared as bytes, all messages at once.
    head = RECORD_HEAD.pack(Op.MESSAGE, stride - RECORD_HEAD.size)
    head += stream.channel.to_bytes(2, "little")
    for at, expected in ((0, head), (_HEAD, stream.cdr)):
        found = np.ndarray((count,), f"V{len(expected)}", raw, begin + at, (stride,))
        if found.tobytes() != expected * count:
            return None
    return range(begin, begin + count * stride, stride)


def _scattered(raw: memoryview, segment: Segment, stream: _Stream) -> NDArray[np.int64]:
    """Return the places of this stream's message records among others."""
    places = []
    for opcode, begin, end in _records(raw, segment):
        if opcode != Op.MESSAGE or _channel_of(raw, begin) != stream.channel:
            continue
        start = begin - RECORD_HEAD.size
        if not 0 <= end - start - stream.least <= _MAX_PADDING:
            raise LogError(
                f"byte {segment.offset}: expected messages of "
                f"{stream.dtype.itemsize + _CDR} bytes, as their schema says, found one of "
                f"{end - start - _HEAD}"
            )
        cdr = bytes(raw[start + _HEAD : start + _HEAD + 2])
        if cdr != stream.cdr:
            raise LogError(
                f"byte {segment.offset}: expected CDR that starts with {stream.cdr.hex(' ')}, "
                f"as in the first message, found {cdr.hex(' ')}"
            )
        places.append(start)
    return np.array(places, np.int64)


def _records(raw: memoryview, segment: Segment) -> Iterator[tuple[int, int, int]]:
    """Yield opcode, begin and end of the body of each record inside a segment."""
    at = 0
    while at < len(raw):
        if len(raw) - at < RECORD_HEAD.size:
            raise LogError(f"byte {segment.offset}: a record in the chunk is cut off")
        opcode, length = RECORD_HEAD.unpack_from(raw, at)
        begin = at + RECORD_HEAD.size
        at = begin + length
        if at > len(raw) or (opcode == Op.MESSAGE and length < MESSAGE_HEAD.size):
            raise LogError(f"byte {segment.offset}: a record in the chunk has a wrong length")
        yield opcode, begin, at


def _channel_of(raw: memoryview, begin: int) -> int:
    return int.from_bytes(raw[begin : begin + 2], "little")


def memory_bytes() -> int:
    """Return the memory of this computer."""
    return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")


def _gib(size: int) -> str:
    return f"{size / 2**30:.3g} GiB"


def _rate_hz(metadata: dict[str, str], times: NDArray[np.uint64]) -> float:
    """Return the rate that the metadata state, else that of the median step between messages."""
    if "rate_hz" in metadata:
        try:
            rate = float(metadata["rate_hz"])
        except ValueError:
            rate = math.nan
        if not 0 < rate < math.inf:
            raise LogError(f"rate_hz: expected a positive number, found {metadata['rate_hz']!r}")
        return rate
    steps = np.diff(times.astype(np.int64))
    if not steps.size or (step := float(np.median(steps))) <= 0:
        raise LogError("expected rate_hz in a Metadata record 'levid', or log times that rise")
    return 1e9 / step
