"""Recover the rows of a damaged log: of every chunk whose content has the size and CRC it states.

A reader walks from record to record, so damage hides all that follows it. Here chunks are found by
their bytes instead: the name of the compression stands in each, and the CRC of its content tells a
chunk from bytes that look like one. A row so is right, or it is not returned.

The description of the rows is in the head, in a copy of it behind the rows, and (without
attachments and metadata) in the summary. The first of these that its CRC confirms is used; a log
that has lost all of them needs another one of the same session.
"""

from __future__ import annotations

import re
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from struct import Struct

import numpy as np
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, Schema
from mcap.writer import MCAP0_MAGIC
from numpy.typing import NDArray

from .errors import LogError
from .mcap_scan import (
    HEAD,
    RECORD_HEAD,
    Contents,
    Decompressor,
    checked_head,
    parsed,
    records,
    scan,
)
from .message_array import MessageLayout, byte_order
from .reader import described_channel, mapped, rate_hz_of
from .unpacked_size import most_unpacked_bytes, too_much
from .writer import LogWriter, new_log_file

_COMPRESSED = re.compile(rb"\x04\0\0\0zstd|\x03\0\0\0lz4", re.DOTALL)
_BEFORE = Struct("<BQQQQI")
"""Of a chunk before the name of its compression: opcode, length, two times, size, CRC."""
_LENGTH = Struct("<Q")
_COPY = re.compile(rb"\x0a\0\0\0" + HEAD.encode() + rb"\x18\0\0\0application/octet-stream")
_BEFORE_COPY = RECORD_HEAD.size + 16
"""Bytes of an attachment before its name: record head and two times."""
_HEAD_END = re.compile(rb"\x0a\0\0\0" + HEAD.encode() + rb"(?=..\0\0\x05\0\0\0bytes)", re.DOTALL)
_FOOTER = Struct("<BQQQI")
_HEAD = "its head"


@dataclass(frozen=True)
class Lost:
    """A damaged part of a log: its first byte and its end, and the row that follows it.

    rows: how many rows are missing there; None where the log does not tell.
    """

    begin: int
    end: int
    before_row: int
    rows: int | None


@dataclass(frozen=True)
class Salvaged:
    """What a damaged log still holds.

    rows (n,) and log_time_ns (n,): of all undamaged chunks, in the order of the file. schema: text
    of the schema. chunks: number of undamaged chunks. described_by: where the description of the
    rows was found, in words. lost: the damaged parts behind the head.
    """

    path: Path
    rows: NDArray[np.void]
    log_time_ns: NDArray[np.uint64]
    rate_hz: float
    schema_name: str
    schema: str
    topic: str
    metadata: dict[str, str]
    attachments: dict[str, bytes]
    chunks: int
    described_by: str
    lost: tuple[Lost, ...]
    whole: bool
    """Whether the log is undamaged, so that there is nothing to salvage."""

    def write(self, out: Path) -> tuple[Path, ...]:
        """Write the rows to a new log, and return its path.

        A log of imported data is written in parts, OUT-1.mcap and so on, as `levid import` does: it
        does not tell identification where rows are missing. Raises LogError if a log exists.
        """
        parts = [slice(0, len(self.rows))]
        if "signals.yaml" in self.attachments:
            cuts = [0, *sorted({lost.before_row for lost in self.lost}), len(self.rows)]
            parts = [slice(a, b) for a, b in pairwise(cuts) if a < b]
        paths = [out.with_stem(f"{out.stem}-{i + 1}") for i in range(len(parts))]
        paths = [out] if len(parts) == 1 else paths
        for path, part in zip(paths, parts, strict=True):
            with (
                new_log_file(path) as file,
                LogWriter(
                    path,
                    self.rows.dtype,
                    file=file,
                    rate_hz=self.rate_hz,
                    metadata={**self.metadata, "salvaged": f"{part.stop - part.start} rows"},
                    attachments=self.attachments,
                    schema_name=self.schema_name,
                    topic=self.topic,
                    schema=self.schema,
                ) as writer,
            ):
                writer.write(self.rows[part], self.log_time_ns[part])
        return tuple(paths)


def salvage(path: Path | str, like: Path | str | None = None) -> Salvaged:
    """Return the rows of all undamaged chunks of a levid log.

    like: another log of the same session, whose description is used if this log has lost its own.

    Raises:
        LogError: not a file, no undamaged chunk, or no description of the rows.
    """
    path = Path(path)
    try:
        data = mapped(path)
        found = list(_chunks(data))
        if not found:
            raise LogError(
                "expected an MCAP log with compressed chunks, found no undamaged chunk in "
                f"{len(data)} bytes"
            )
        head, described_by = _description(data, path, like)
        return _salvaged(path, data, found, head, described_by)
    except LogError as error:
        raise LogError(f"{path}: {error}") from None


@dataclass(frozen=True)
class _Found:
    """An undamaged chunk: its first byte and its end in the file, and its records."""

    begin: int
    end: int
    raw: memoryview


def _salvaged(
    path: Path, data: memoryview, found: list[_Found], head: Contents, described_by: str
) -> Salvaged:
    number, dtype = described_channel(head)
    channel = head.channels[number]
    rows: list[NDArray[np.void]] = []
    times: list[NDArray[np.uint64]] = []
    chunks: list[_Found] = []
    for chunk in found:
        where = f"byte {chunk.begin}: chunk: "
        cdr = byte_order(chunk.raw, number, where)
        if cdr is None:
            continue
        in_file = dtype if cdr == b"\x00\x01" else dtype.newbyteorder(">")
        messages = MessageLayout(number, in_file, cdr).find(chunk.raw, where)
        own = np.ascontiguousarray(messages["payload"]).view(in_file)[:, 0].astype(dtype)
        _check_numbers(own, messages["sequence"], where)
        if rows and "cycle" in (dtype.names or ()) and own["cycle"][0] <= rows[-1]["cycle"][-1]:
            continue  # a part of the file that stands in it twice
        rows.append(own)
        times.append(messages["log_time"])
        chunks.append(chunk)
    if not rows:
        raise LogError(f"no undamaged chunk with messages on {channel.topic}")
    log_time_ns = np.concatenate(times)
    schema = head.schemas[channel.schema_id]
    metadata = head.metadata.get("levid", {})
    lost = tuple(_lost(data, chunks, rows))
    return Salvaged(
        path=path,
        rows=np.concatenate(rows),
        log_time_ns=log_time_ns,
        rate_hz=rate_hz_of(metadata, log_time_ns),
        schema_name=schema.name,
        schema=str(schema.data, "utf-8", "replace"),
        topic=channel.topic,
        metadata=metadata,
        attachments=head.attachments,
        chunks=len(chunks),
        described_by=described_by,
        lost=lost,
        whole=not lost and described_by == _HEAD and scan(data).problem is None,
    )


def _check_numbers(rows: NDArray[np.void], sequence: NDArray[np.uint32], where: str) -> None:
    """Check that the description fits: levid numbers each message by its row's cycle."""
    if "cycle" not in (rows.dtype.names or ()):
        return
    if not np.array_equal(rows["cycle"] & np.uint64(0xFFFFFFFF), sequence):
        raise LogError(
            f"{where}the description of the rows does not fit them: cycle is not the number of the "
            "message; use a log of the same session"
        )


def _chunks(data: memoryview) -> Iterator[_Found]:
    """Yield the undamaged chunks, in the order of the file."""
    decompress, end, unpacked = Decompressor(), 0, 0
    for match in _COMPRESSED.finditer(data):
        begin = match.start() - _BEFORE.size
        length_at = match.end()
        if begin < end or length_at + _LENGTH.size > len(data):
            continue
        *_, size, crc = _BEFORE.unpack_from(data, begin)
        packed_at = length_at + _LENGTH.size
        chunk_end = packed_at + _LENGTH.unpack_from(data, length_at)[0]
        if crc == 0 or chunk_end > len(data):
            continue
        compression = match.group()[4:].decode()
        packed = data[packed_at:chunk_end]
        try:
            raw = decompress(begin, Chunk(compression, packed, 0, 0, crc, size))  # type: ignore[arg-type]
        except LogError:
            continue
        unpacked += size
        if unpacked > most_unpacked_bytes(len(data)):
            raise LogError(too_much(len(data), unpacked))
        end = chunk_end
        yield _Found(begin, chunk_end, raw)


def _lost(data: memoryview, chunks: list[_Found], rows: list[NDArray[np.void]]) -> Iterator[Lost]:
    """Yield the damaged parts before, between and behind undamaged chunks."""
    begin = _first_chunk(data)
    before = 0
    for number, chunk in enumerate(chunks):
        if begin < chunk.begin:
            missing = _missing(rows[number - 1], rows[number]) if number else None
            yield Lost(begin, chunk.begin, before, missing)
        begin = _after_index(data, chunk.end)
        before += len(rows[number])
    if not _ends_well(data, begin):
        yield Lost(min(begin, len(data)), len(data), before, None)


def _ends_well(data: memoryview, begin: int) -> bool:
    """Return whether nothing but the end of a log follows, without another chunk."""
    try:
        for opcode, _, end in records(data, begin):
            if opcode == Opcode.FOOTER:
                return data[end:] == MCAP0_MAGIC
            if opcode in (Opcode.CHUNK, Opcode.MESSAGE, Opcode.MESSAGE_INDEX):
                return False
    except LogError:
        pass
    return False


def _missing(one: NDArray[np.void], other: NDArray[np.void]) -> int | None:
    if "cycle" not in (one.dtype.names or ()):
        return None
    return max(int(other["cycle"][0]) - int(one["cycle"][-1]) - 1, 0)


def _first_chunk(data: memoryview) -> int:
    """Return where the head of a log ends: behind the metadata with its CRC, if these are there."""
    found = _HEAD_END.search(data)
    if found is None:
        return len(data)  # damage of the head is reported by itself
    begin = found.start() - RECORD_HEAD.size
    return found.start() + int(RECORD_HEAD.unpack_from(data, max(begin, 0))[1])


def _after_index(data: memoryview, at: int) -> int:
    """Return the end of the index that follows a chunk, or `at` if it is damaged."""
    if at + RECORD_HEAD.size > len(data):
        return at
    opcode, length = RECORD_HEAD.unpack_from(data, at)
    return at + RECORD_HEAD.size + int(length) if opcode == Opcode.MESSAGE_INDEX else at


def _step_of(name: str) -> dict[str, str]:
    """Return step, name and kind of a session's log from its file's name, as the daemon gives it.

    They are what another log of the session does not know.
    """
    found = re.fullmatch(r"(\d{2,})-([A-Za-z0-9][A-Za-z0-9._-]*?)(?:\.\d+)?", name)
    if found is None:
        return {}
    step, named = found.groups()
    kind = named if named in ("levitate", "move", "land") else "record"
    return {"step": str(int(step)), "name": named, "kind": kind}


def _description(data: memoryview, path: Path, like: Path | str | None) -> tuple[Contents, str]:
    """Return head or summary, and where it was found."""
    own = checked_head(data)
    if own is not None:
        return own, _HEAD
    copy = _copy_of_head(data)
    if copy is not None:
        return copy, "the copy of its head behind the rows"
    if like is not None:
        other = checked_head(mapped(Path(like)))
        if other is None:
            raise LogError(f"{like}: expected a log of levid with an undamaged head")
        own_step = _step_of(path.stem)
        if own_step and "levid" in other.metadata:
            other.metadata["levid"] = {**other.metadata["levid"], **own_step}
        return other, str(like)
    summary = _summary(data)
    if summary is not None:
        return summary, "its summary, without attachments and metadata"
    raise LogError(
        "head, its copy and summary are damaged or cut off, so nothing describes the rows: give "
        "another log of the same session with --like"
    )


def _copy_of_head(data: memoryview) -> Contents | None:
    for match in _COPY.finditer(data):
        begin = match.start() - _BEFORE_COPY + RECORD_HEAD.size
        length_at = match.end()
        if begin < 0 or length_at + _LENGTH.size > len(data):
            continue
        content_at = length_at + _LENGTH.size
        end = content_at + _LENGTH.unpack_from(data, length_at)[0]
        crc = int.from_bytes(data[end : end + 4], "little")
        if end + 4 <= len(data) and zlib.crc32(data[begin:end]) == crc:
            return checked_head(data[content_at:end])
    return None


def _summary(data: memoryview) -> Contents | None:
    """Return the schemas and channels of an undamaged summary."""
    footer_at = len(data) - len(MCAP0_MAGIC) - _FOOTER.size
    if footer_at < 0:
        return None
    opcode, length, start, _, crc = _FOOTER.unpack_from(data, footer_at)
    covered = footer_at + _FOOTER.size - 4
    if opcode != Opcode.FOOTER or length != _FOOTER.size - RECORD_HEAD.size or not crc:
        return None
    if not 0 < start < footer_at or zlib.crc32(data[start:covered]) != crc:
        return None
    contents = Contents()
    for kind, at, end in records(data[:footer_at], start):
        if kind in (Opcode.SCHEMA, Opcode.CHANNEL):
            record: Schema | Channel = parsed(data, kind, at, end)
            contents.declare(record, f"byte {at}")
    return contents if contents.channels else None
