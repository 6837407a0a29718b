"""Read a log chunk by chunk, in memory that does not grow with its length."""

from __future__ import annotations

import contextlib
import mmap
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from .errors import LogError
from .field_units import FieldMeaning, field_meanings
from .mcap_scan import Contents, Decompressor, scan
from .reader import (
    described_channel,
    mapped,
    message_layout,
    rate_hz_of,
    stated_rows,
    wrong_count,
)


@dataclass(frozen=True)
class Block:
    """Rows that follow one another: rows (n,) and their log_time_ns (n,) in ns."""

    rows: NDArray[np.void]
    log_time_ns: NDArray[np.uint64]


class LogStream:
    """One log, whose rows are read block by block.

    dtype: fields of a row, as in the schema. rate_hz, schema_name, metadata, attachments: as in
    `Log`. meanings: units and words by field. stated_rows: number of rows by the log's statistics,
    None if it has none (a log that was cut off). problem: why the log is incomplete, None if it is
    whole; final after the last block.

    Raises:
        LogError: as `read_log`; a log larger than the memory is not an error.
    """

    def __init__(self, path: Path | str) -> None:
        self.path = Path(path)
        try:
            self._data = mapped(self.path)
            contents = scan(self._data, self._release)
            self._open(contents)
        except LogError as error:
            raise LogError(f"{path}: {error}") from None
        self._release(len(self._data))

    def _open(self, contents: Contents) -> None:
        self._contents = contents
        self._number, self.dtype = described_channel(contents)
        self._layout, _ = message_layout(contents, self._number, self.dtype)
        schema = contents.schemas[contents.channels[self._number].schema_id]
        self.schema_name = schema.name
        self.meanings: dict[str, FieldMeaning] = field_meanings(
            str(schema.data, "utf-8", "replace")
        )
        self.metadata = contents.facts
        self.attachments = contents.attachments
        self.problem = contents.problem
        self.stated_rows = stated_rows(contents, self._number)
        first = self.first_block()
        if first is None:
            raise LogError(self.problem or "expected rows, found none")
        self.rate_hz = rate_hz_of(self.metadata, first.log_time_ns)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the fields, in the order of the schema."""
        return self.dtype.names or ()

    @property
    def file_bytes(self) -> int:
        """Size of the file."""
        return len(self._data)

    @property
    def chunks(self) -> int:
        """Number of chunks of the file: at least as many as blocks."""
        return max(len(self._contents.chunks), 1)

    def blocks(self) -> Iterator[Block]:
        """Yield all rows in the order of the file; a damaged log ends before its first damage."""
        self.problem = self._contents.problem
        rows = 0
        for block in self._read(iter(self._contents.chunks)):
            rows += len(block.rows)
            yield block
        self.problem = self.problem or wrong_count(self.stated_rows, rows)

    def last_block(self) -> Block | None:
        """Return the rows of the last chunk that has some; None if it is damaged."""
        return next(self._read(reversed(self._contents.chunks)), None)

    def first_block(self) -> Block | None:
        """Return the rows of the first chunk that has some; None if it is damaged."""
        return next(self._read(iter(self._contents.chunks)), None)

    def _read(self, offsets: Iterator[int]) -> Iterator[Block]:
        decompress = Decompressor()
        for offset in offsets:
            try:
                raw = decompress(offset, self._contents.chunks[offset])
                messages = self._layout.find(raw, f"byte {offset}: chunk: ")
            except LogError as error:
                self.problem = self.problem or str(error)
                return
            if messages.size:
                payload = np.ascontiguousarray(messages["payload"])
                rows = payload.view(self._layout.payload)[:, 0]
                times = messages["log_time"].copy()
                self._release(offset)
                yield Block(rows if rows.dtype == self.dtype else rows.astype(self.dtype), times)

    def _release(self, end: int) -> None:
        """Give back the memory of the file's pages up to `end`; they are read again if needed."""
        pages = self._data.obj
        end -= end % mmap.PAGESIZE
        if isinstance(pages, mmap.mmap) and end > 0:
            with contextlib.suppress(OSError, ValueError):
                pages.madvise(mmap.MADV_DONTNEED, 0, end)
