"""Read a log into arrays: a chunk of fixed-size messages is one strided array, not a loop."""

from __future__ import annotations

import difflib
import math
import mmap
import os
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from mcap.records import Channel, Chunk
from mcap.well_known import MessageEncoding, SchemaEncoding
from numpy.typing import NDArray

from ..config.files.reading import open_file
from .errors import LogError
from .mcap_scan import MAX_CHUNK_BYTES, Contents, Decompressor, scan
from .message_array import CDR_LE, MessageLayout, byte_order
from .signals import SIGNALS, dtype_from_ros2msg


@dataclass(frozen=True)
class Log:
    """One log in arrays.

    rows: structured array (n,), fields named as in the schema, in the order of the file.
    log_time_ns: (n,), ns. rate_hz: from the metadata, else from the log times. metadata: pairs of
    the record "levid". attachments: contents by name. complete: False for a log that was cut off or
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
        """Return one field, (n,) or (n, length); raise LogError if it is absent."""
        names = self.rows.dtype.names or ()
        if name not in names:
            close = difflib.get_close_matches(name, names, n=3) or names
            raise LogError(f"{self.path}: no field '{name}'; there is {', '.join(close)}")
        return self.rows[name]


def read_log(path: Path | str) -> Log:
    """Read a log of levid, or any MCAP file with fixed-size CDR messages.

    If there are several channels, read the one that carries signals of levid, or the only one whose
    schema has a fixed size.

    Raises:
        LogError: no such file, not MCAP, no such channel, no messages, damaged before the end of
            the first chunk, or larger when decompressed than this computer's memory; with file,
            byte, what was expected and what was found.
    """
    path = Path(path)
    try:
        return _read(path, mapped(path))
    except LogError as error:
        raise LogError(f"{path}: {error}") from None


def memory_bytes() -> int:
    """Return the memory of this computer in bytes."""
    return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")


def mapped(path: Path) -> memoryview:
    """Return the bytes of a file, read as they are needed; raise LogError if it is not one."""
    try:
        if path.is_dir():
            raise LogError("expected a log, found a folder: give the logs in it, as FOLDER/*.mcap")
        with open_file(path) as file:
            if os.fstat(file.fileno()).st_size == 0:
                return memoryview(b"")
            return memoryview(mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ))
    except OSError as error:
        known = "" if (error.strerror or "").startswith("expected") else "cannot be read: "
        raise LogError(f"{known}{error.strerror or error}") from None


def _read(path: Path, data: memoryview) -> Log:
    contents = scan(data)
    channel, dtype = described_channel(contents)
    layout, first = message_layout(contents, channel, dtype)
    rows, times, problem = _read_rows(contents.chunks, layout, first, len(data))
    problem = problem or contents.problem
    problem = problem or wrong_count(stated_rows(contents, channel), rows.size)
    if not rows.size:
        raise LogError(problem or f"no messages on {contents.channels[channel].topic}")
    metadata = contents.facts
    return Log(
        path=path,
        rows=rows if rows.dtype == dtype else rows.astype(dtype),
        log_time_ns=times,
        rate_hz=rate_hz_of(metadata, times),
        schema_name=contents.schemas[contents.channels[channel].schema_id].name,
        metadata=metadata,
        attachments=contents.attachments,
        complete=problem is None,
        problem=problem,
    )


def stated_rows(contents: Contents, channel: int) -> int | None:
    """Return the channel's number of messages by the statistics; None without statistics."""
    counts = contents.message_counts
    return None if counts is None else counts.get(channel, 0)


def wrong_count(stated: int | None, found: int) -> str | None:
    """Return what is wrong if the statistics state another number of messages."""
    if stated in (None, found):
        return None
    return f"expected {stated} messages, as the statistics state, found {found}"


def described_channel(contents: Contents) -> tuple[int, np.dtype[np.void]]:
    """Return number and little-endian dtype of the channel to read."""
    fixed: dict[int, np.dtype[np.void]] = {}
    reasons = []
    for number, channel in contents.channels.items():
        try:
            fixed[number] = _channel_dtype(contents, channel)
        except LogError as error:
            reasons.append(f"{channel.topic}: {error}")
    ours = {s.name for s in SIGNALS}
    candidates = {n: d for n, d in fixed.items() if ours & set(d.names or ())} or fixed
    if len(candidates) == 1:
        return next(iter(candidates.items()))
    if not contents.channels:
        raise LogError(contents.problem or "expected a channel with messages, found none")
    if not candidates:
        raise LogError(f"no channel of fixed-size messages: {'; '.join(reasons)}")
    topics = ", ".join(contents.channels[number].topic for number in candidates)
    raise LogError(f"expected one channel of fixed-size messages, found {topics}")


def _channel_dtype(contents: Contents, channel: Channel) -> np.dtype[np.void]:
    schema = contents.schemas.get(channel.schema_id)
    found = (channel.message_encoding, schema.encoding if schema else "no schema")
    if schema is None or found != (MessageEncoding.CDR, SchemaEncoding.ROS2):
        raise LogError(
            f"expected messages in cdr and a schema in ros2msg, found {' and '.join(found)}"
        )
    return dtype_from_ros2msg(str(schema.data, "utf-8", "replace"))


def message_layout(
    contents: Contents, channel: int, dtype: np.dtype[np.void]
) -> tuple[MessageLayout, dict[int, memoryview]]:
    """Return the layout of the channel's messages, in the byte order of the first one.

    Also return its decompressed chunk, by offset, so that it is not decompressed again.
    """
    decompress = Decompressor()
    for offset, chunk in contents.chunks.items():
        raw = decompress(offset, chunk)
        cdr = byte_order(raw, channel, f"byte {offset}: chunk: ")
        if cdr is not None:
            in_file = dtype if cdr == CDR_LE else dtype.newbyteorder(">")
            return MessageLayout(channel, in_file, cdr), {offset: raw}
    topic = contents.channels[channel].topic
    raise LogError(contents.problem or f"expected messages on {topic}, found none")


def _read_rows(
    chunks: Mapping[int, Chunk],
    layout: MessageLayout,
    known: Mapping[int, memoryview],
    file_bytes: int,
) -> tuple[NDArray[np.void], NDArray[np.uint64], str | None]:
    """Return rows, times, and the error of the first chunk that could not be read."""
    # A chunk that states too large a size fails to decompress: it gets no memory. The sum of the
    # sizes may be too large as well: zstd compresses zeros to almost no bytes.
    sizes = [chunk.uncompressed_size for chunk in chunks.values()]
    sizes = [size if size <= MAX_CHUNK_BYTES else 0 for size in sizes]
    if sum(sizes) > (memory := memory_bytes()):
        raise LogError(
            f"expected a log that this computer's memory of {_gib(memory)} holds, found one of "
            f"{_gib(sum(sizes))} when decompressed ({_gib(file_bytes)} on disk)"
        )
    room = [size // layout.dtype.itemsize for size in sizes]
    starts = np.concatenate([[0], np.cumsum(room)]).tolist()
    try:
        rows = np.empty(starts[-1], layout.payload)
        times = np.empty(starts[-1], np.uint64)
    except MemoryError:
        raise LogError(f"not enough memory for {starts[-1]} messages") from None

    payloads = rows.view(np.uint8).reshape(-1, layout.payload.itemsize)
    placed = list(zip(chunks.items(), starts, strict=False))

    def read(part: slice) -> list[int | LogError]:
        """Fill in the rows of some chunks; return the number of rows of each."""
        decompress = Decompressor()
        counts: list[int | LogError] = []
        for (offset, chunk), start in placed[part]:
            try:
                raw = known[offset] if offset in known else decompress(offset, chunk)
                messages = layout.find(raw, f"byte {offset}: chunk: ")
            except LogError as error:
                return [*counts, error]
            place = slice(start, start + messages.size)
            times[place], payloads[place] = messages["log_time"], messages["payload"]
            counts.append(messages.size)
        return counts

    # Decompression, CRC and copies release the interpreter's lock. Each task reads several chunks,
    # because starting a task takes as long as reading a small chunk.
    workers = min(4, os.cpu_count() or 1)
    step = -(-len(placed) // (4 * workers)) or 1
    parts = [slice(i, i + step) for i in range(0, len(placed), step)]
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


def _gib(size: int) -> str:
    return f"{size / 2**30:.3g} GiB"


def rate_hz_of(metadata: dict[str, str], times: NDArray[np.uint64]) -> float:
    """Return the rate stated by the metadata, else the rate of the median time step."""
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
