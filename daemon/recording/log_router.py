"""Write rows from the ring to log files, each row to the log of its tag."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from enum import StrEnum
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...config.files.folders import make_folder
from ...log.errors import LogError
from ...log.writer import LogWriter
from ..host.lost_log import Loss, LostLog, find_loss, save_deleted
from ..ipc.row_ring import NO_LOG, Ring, RingRows

BLOCK = 8192
"""Rows read from the ring at a time. With fewer rows waiting, a reader pauses: each turn costs as
much as copying some hundred rows."""


@dataclass(frozen=True)
class LogFile:
    """Describe a log to write: path, metadata and attachments.

    A log that exceeds its size or length, or whose recorder was restarted, continues in
    `name.2.mcap` and so on; `part` is the first part to write.
    """

    path: Path
    metadata: Mapping[str, str]
    attachments: Mapping[str, bytes]
    part: int = 1

    def path_of(self, part: int) -> Path:
        """Return the path of a part."""
        return self.path if part == 1 else self.path.with_suffix(f".{part}{self.path.suffix}")


def bring_back(path: Path, descriptor: int, _tag: int = NO_LOG) -> None:
    """Copy a deleted log to its path again, and close its descriptor; raises OSError."""
    try:
        save_deleted(path, descriptor)
    finally:
        os.close(descriptor)


@dataclass(frozen=True)
class Rotation:
    """Limit the size of one file; the next part follows."""

    max_bytes: int
    max_rows: int


class Event(StrEnum):
    """Name what happened to a file: opened, closed completely, failed.

    Deleted by somebody, and restored from the open file; lost: cut off, or no longer at its path.
    """

    OPENED = "opened"
    CLOSED = "closed"
    FAILED = "failed"
    DELETED = "deleted"
    LOST = "lost"
    RESTORED = "restored"


Report = Callable[[Event, int, Path, str], None]
"""Called with the event, the tag of the log, the file and the reason of a failure or loss."""
Save = Callable[[Path, int, int], None]
"""Called with a deleted log, an open descriptor of it, to be closed, and the log's tag."""


class LogRouter:
    """Write the rows of a ring as its only reader; `log_of` returns the log of a tag, or None.

    A disk error stops recording until `forget_errors`, but never the flight: `error` holds it, and
    `dropped` counts the rows that were not recorded. A log that is deleted or cut off on the disk
    continues in its next part; `save` brings a deleted one back.
    """

    def __init__(
        self,
        ring: Ring,
        rate_hz: float,
        log_of: Callable[[int], LogFile | None],
        report: Report = lambda *_: None,
        rotation: Rotation | None = None,
        save: Save = bring_back,
    ) -> None:
        self._ring, self._rate_hz, self._log_of, self._report = ring, rate_hz, log_of, report
        self._rotation, self._save = rotation, save
        self._period_ns = 1e9 / rate_hz
        self.epoch_ns = 0
        self.error: Exception | None = None
        self.dropped = 0
        self._tag = NO_LOG
        self._part = 0
        self._rows = 0
        self._full = False
        self._file: LogFile | None = None
        self._writer: LogWriter | None = None
        self._cut_off = False
        self._moved: Path | None = None  # last log that was found moved

    @property
    def tag(self) -> int:
        """Tag of the current log."""
        return self._tag

    @property
    def writer(self) -> LogWriter | None:
        """Writer of the current file, None if no file is open."""
        return self._writer

    def forget_errors(self) -> None:
        """Resume recording after a failure, from the next log on."""
        self.error = None

    def cut_off(self) -> None:
        """Leave the current log, and any later one, without an end: a reader says so."""
        self._cut_off = True

    def work(self) -> RingRows:
        """Read a block of rows, write it to its logs, and return it; empty if none is waiting."""
        ring = self._ring
        read = ring.take(BLOCK)
        tags = read.tags
        edges = [0, *(np.flatnonzero(np.diff(tags)) + 1).tolist(), len(tags)]
        for begin, end in pairwise(edges):
            if begin < end:
                if tags[begin] != self._tag:
                    self._switch(int(tags[begin]))
                    ring.durable = read.first + begin
                self._write(read.rows[begin:end])
                # Update at once: a restarted recorder writes rows after this again.
                buffered = self._writer.buffered if self._writer is not None else 0
                ring.durable = read.first + end - buffered
        return read

    def finish(self) -> None:
        """Close the current log: no more rows of it will come."""
        self._switch(NO_LOG)
        self._ring.durable = self._ring.tail

    def _write(self, rows: NDArray[np.void]) -> None:
        if self._full:  # only when rows follow: no empty last part
            self._full = False
            self._open(self._part + 1)
        if self._writer is None:
            self.dropped += len(rows) if self._tag != NO_LOG else 0
            return
        writer = self._writer
        times = self.epoch_ns + np.rint(rows["cycle"] * self._period_ns).astype(np.uint64)
        self._guard(lambda: writer.write(rows, times), writer.buffered + len(rows))
        self._rows += len(rows)
        rotation = self._rotation
        if (
            rotation is not None
            and self._writer is not None
            and (writer.size >= rotation.max_bytes or self._rows >= rotation.max_rows)
        ):
            self._close()
            self._full = True

    def _switch(self, tag: int) -> None:
        self._close()
        self._full = False
        self._tag = tag
        self._file = self._log_of(tag) if tag != NO_LOG else None
        if tag != NO_LOG and self._file is None:  # no disk error: the next log is written
            self._report(Event.FAILED, tag, Path(), f"log {tag} is unknown")
        if self._file is not None:
            self._open(self._file.part)

    def _open(self, part: int) -> None:
        file = self._file
        if file is None or self.error is not None:
            return
        path = file.path_of(part)

        def begin() -> None:
            self._writer = LogWriter(
                path,
                self._ring.dtype,
                rate_hz=self._rate_hz,
                metadata={**file.metadata, **({"part": str(part)} if part > 1 else {})},
                attachments=file.attachments,
            )
            self._part, self._rows = part, 0
            self._report(Event.OPENED, self._tag, path, "")

        self._guard(begin, 0, path)

    def lose(self, lost: LostLog) -> None:
        """Report what happened to the current file; continue in the next part if it is not whole.

        Nothing happens if `lost` is another file.
        """
        writer = self._writer
        if writer is None or writer.path != lost.path:
            return
        if lost.loss is Loss.MOVED:
            if self._moved != lost.path:
                self._moved = lost.path
                self._report(Event.LOST, self._tag, lost.path, lost.words)
            return

        deleted = os.dup(writer.fileno()) if lost.loss is Loss.DELETED else -1
        try:
            writer.close()  # the last rows go to the file all the same: it is copied as it is now
        except LogError:
            self.dropped += writer.buffered
        self._writer, self._full = None, True
        event = Event.DELETED if deleted >= 0 else Event.LOST
        self._report(event, self._tag, lost.path, lost.words)
        if deleted >= 0:
            with suppress(OSError):  # its folder was perhaps deleted with it
                make_folder(lost.path.parent)
            self._guard(lambda: self._save(lost.path, deleted, self._tag), 0, lost.path)

    def _close(self) -> None:
        writer = self._writer
        if writer is not None:
            with suppress(OSError):
                if lost := find_loss(writer.path, writer.fileno(), writer.size):
                    self.lose(lost)
        writer = self._writer
        if writer is None:
            return

        def end() -> None:
            writer.close(whole=not self._cut_off)
            self._writer = None
            self._report(Event.CLOSED, self._tag, writer.path, "")

        self._guard(end, writer.buffered)

    def _guard(self, action: Callable[[], None], rows: int, path: Path | None = None) -> None:
        """Run `action`; on an error, store it, count `rows` as dropped and abandon the file."""
        try:
            action()
        except Exception as error:  # noqa: BLE001 - stored in `error`; the flight goes on
            self.error = self.error or error
            self.dropped += rows
            if path is None and self._writer is not None:
                path = self._writer.path
            self._writer = None
            self._report(Event.FAILED, self._tag, path or Path(), str(error))
