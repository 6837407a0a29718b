"""Recorder process: write rows from shared memory to logs and flight recordings."""

from __future__ import annotations

import base64
import contextlib
import json
import os
import select
import signal
import socket
import sys
import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from ...config.rig import RigConfig
from ...log.errors import LogError
from ...log.mcap_scan import scan
from ...log.writer import BEGINNING
from ..control.faults import Fault
from ..host.child_process import receive_signals
from ..host.fsync_worker import FsyncWorker
from ..host.lost_log import LostLog, save_deleted
from ..host.real_time_scheduling import set_process_name
from ..ipc.json_lines import Closed, Lines
from ..ipc.row_ring import NO_LOG
from ..ipc.shared_memory import SharedMemory
from ..ipc.shared_status_words import Word
from .fault_recorder import FaultLog
from .log_metadata import attachments
from .log_router import BLOCK, Event, LogFile, LogRouter, Rotation

_POLL_S = 0.01
_SYNC_S = 5.0
_MAX_BYTES = 16 << 20
_WITHOUT_ROWS_S = 1.0
_UNKNOWN_S = 1.0


class RecorderProcess:
    """Record until the supervisor requests the end, or supervisor and loop have both ended."""

    def __init__(
        self, rig: RigConfig, shared: SharedMemory, end: socket.socket, faults: Path
    ) -> None:
        self._control_words, self._ring = shared.control_words, shared.ring
        self._lines = Lines(end, _MAX_BYTES, _MAX_BYTES)
        self._fsync_worker = FsyncWorker()
        self._logs: dict[int, LogFile] = {}
        self._head: Mapping[str, bytes] = {}
        self._tags: dict[Path, int] = {}  # of the current logs
        self._fault_logs: dict[Path, str] = {}  # fault of the last flight recording
        self._ready_request = 0  # last unanswered request to report readiness, 0 for none
        self._ending = False
        self._closed = NO_LOG  # last tag that the supervisor has forgotten
        self._failed = NO_LOG  # tag of the last log that could not be written
        self._requested: list[Fault] = []  # recordings that wait until the router is free
        self._switching = False  # the router is switching logs
        self._restoring: list[int] = []  # tags of deleted logs that are being copied
        rotation = Rotation(
            int(rig.recording.rotate_mb * 1e6), int(rig.recording.rotate_s * rig.rate_hz)
        )
        self._router = LogRouter(
            self._ring, rig.rate_hz, self._log_of, self._on_log_event, rotation, self._save
        )
        self._faults = FaultLog(
            self._ring,
            rig.rate_hz,
            faults,
            rig.recording,
            {
                name: data
                for name, data in attachments(rig, rig.model_dump_json().encode(), b"").items()
                if data
            },
            self._on_fault_recording,
        )
        self._router.dropped = self._control_words[Word.DROPPED]  # continue the count
        # Read again the rows that a dead recorder read but did not write.
        self._ring.tail = self._ring.durable
        # Set before the first message, which may request the recording of a dead loop.
        self._router.epoch_ns = self._faults.epoch_ns = self._control_words[Word.EPOCH_NS]
        self._faults.resume(self._control_words[Word.FAULTS_SEEN], self._ring.tail)

    def run(self, parent: int) -> None:
        """Record; `parent` is the process id of the supervisor."""
        words = self._control_words.words
        quiet_since_s, cycle = time.monotonic(), words[Word.CYCLE]
        while True:
            self._receive(0.0 if self._ring.waiting >= BLOCK else _POLL_S)
            self._router.epoch_ns = self._faults.epoch_ns = words[Word.EPOCH_NS]
            log = words[Word.LOG]
            read = self._router.work()
            if not len(read.rows) and self._router.tag not in (NO_LOG, log):
                self._router.finish()  # the log is complete; on a dead bus no rows follow
            self._faults.scan(read)
            if self._faults.idle:
                words[Word.FAULTS_SEEN] = self._ring.tail
            self._sync()
            words[Word.DROPPED] = self._router.dropped
            words[Word.WRITING] = self._writing
            words[Word.RECORDER_BEAT] += 1
            if self._ready_request and self._ring.waiting < BLOCK:
                self._send({"event": "ready", "ready": self._ready_request})
                self._ready_request = 0
            if len(read.rows):
                continue
            if os.getppid() == parent:
                if self._ending:
                    break
                continue
            # The supervisor has ended: record the last rows of the loop, until it stops too.
            if words[Word.CYCLE] != cycle:
                quiet_since_s, cycle = time.monotonic(), words[Word.CYCLE]
            elif time.monotonic() - quiet_since_s > _WITHOUT_ROWS_S:
                break
        self._router.finish()
        self._faults.finish()
        self._fsync_worker.finish(_SYNC_S)
        self._sync()
        words[Word.WRITING] = self._writing

    @property
    def _writing(self) -> int:
        """Tag of the log that is written, or restored after it was deleted."""
        return next(iter(self._restoring), self._router.tag)

    def _save(self, path: Path, descriptor: int, tag: int) -> None:
        """Restore a deleted log in the thread: copying takes time, and rows keep coming."""
        self._restoring.append(tag)
        self._fsync_worker.run(path, lambda: _restored(path, descriptor, tag))

    def _sync(self) -> None:
        self._fsync_worker.sync_growing(self._router.writer)
        for found in self._fsync_worker.found():
            if isinstance(found, LostLog):
                self._router.lose(found)
            elif isinstance(found, _Restored):
                self._restoring.remove(found.tag)
                self._send_log_event(Event.RESTORED, found.tag, found.path, found.why)
        for path, why in self._fsync_worker.failures():
            if path in self._fault_logs:
                self._send(
                    {"event": "fault", "fault": self._fault_logs[path], "path": "", "why": why}
                )
            else:
                tag = self._tags.get(path, self._router.tag)
                self._send_log_event(Event.FAILED, tag, path, why)

    def _receive(self, wait_s: float) -> None:
        """Execute the supervisor's messages; wait at most `wait_s` for one."""
        while self._requested and not self._switching:
            self._record(self._requested.pop(0))
        try:
            ready, _, _ = select.select([self._lines.socket], [], [], wait_s)
            if ready:
                self._lines.receive()
            for line in self._lines.lines():
                self._execute(json.loads(line))
        except Closed:
            # The supervisor has ended: go on as long as rows come.
            time.sleep(wait_s)

    def _execute(self, message: Mapping[str, Any]) -> None:
        if "head" in message:
            self._head = {name: base64.b64decode(data) for name, data in message["head"].items()}
        if "log" in message:
            file = LogFile(
                Path(message["path"]), message["metadata"], self._head, int(message["part"])
            )
            if message["again"]:
                file = without_empty_part(file)
            self._logs[int(message["log"])] = file
        if "forget" in message:
            # Keep the logs of the previous flight: after a restart, the ring still has their rows.
            before, self._closed = self._closed, int(message["forget"])
            self._logs = {tag: log for tag, log in self._logs.items() if tag > before}
            self._tags = {path: tag for path, tag in self._tags.items() if tag > before}
            self._router.forget_errors()
        if "fault" in message:
            fault = Fault[message["fault"]]
            if self._switching:
                self._requested.append(fault)
            else:
                self._record(fault)
        if "ready" in message:
            self._ready_request = int(message["ready"])
        if "end" in message:
            self._ending = True

    def _record(self, fault: Fault) -> None:
        """Write the flight recording of a fault that the dead loop could not log."""
        while len(self._router.work().rows):
            pass
        self._router.finish()
        self._faults.finish()
        self._faults.write(fault)

    def _log_of(self, tag: int) -> LogFile | None:
        deadline_s = time.monotonic() + _UNKNOWN_S
        self._switching = True  # messages must not use the router meanwhile
        try:
            while tag not in self._logs and time.monotonic() < deadline_s:
                self._receive(_POLL_S)
        finally:
            self._switching = False
        if self._failed <= self._closed < tag:
            # An error of the previous flight must not stop this log.
            self._router.forget_errors()
        return self._logs.get(tag)

    def _on_log_event(self, event: Event, tag: int, path: Path, why: str) -> None:
        if event is Event.OPENED:
            self._tags[path] = tag
            if tag in self._logs:  # if the log is opened again, continue in the next part
                log = self._logs[tag]
                self._logs[tag] = replace(log, part=log.part + 1)
        elif event is Event.CLOSED:
            self._fsync_worker.sync_closed(path)
        elif event is Event.FAILED:
            self._failed = tag
        self._send_log_event(event, tag, path, why)

    def _send_log_event(self, event: Event, tag: int, path: Path, why: str) -> None:
        self._send({"event": event, "log": tag, "path": str(path), "why": why})

    def _on_fault_recording(self, fault: Fault, path: str, why: str) -> None:
        if path:
            self._fault_logs = {Path(path): fault.name}
            self._fsync_worker.sync_closed(Path(path))
        self._send({"event": "fault", "fault": fault.name, "path": path, "why": why})

    def _send(self, message: Mapping[str, Any]) -> None:
        with contextlib.suppress(Closed):
            self._lines.put(message)


@dataclass(frozen=True)
class _Restored:
    """The copy of a deleted log of a tag, or why there is none."""

    tag: int
    path: Path
    why: str = ""


def _restored(path: Path, descriptor: int, tag: int) -> _Restored:
    try:
        return _Restored(tag, save_deleted(path, descriptor))
    except OSError as error:
        return _Restored(tag, path, error.strerror or str(error))
    finally:
        os.close(descriptor)


def without_empty_part(file: LogFile) -> LogFile:
    """Remove the last part of a log if a dead recorder left it without rows.

    This may be the previous part, or a part that it did not report. Other files stay: the log
    continues in the next free part.
    """
    while file.path_of(file.part).exists() and not _remove_if_empty(file.path_of(file.part)):
        file = replace(file, part=file.part + 1)
    if file.part > 1 and _remove_if_empty(file.path_of(file.part - 1)):
        file = replace(file, part=file.part - 1)
    return file


def _remove_if_empty(path: Path) -> bool:
    """Remove a log without rows, complete or truncated; return whether it was removed."""
    try:
        if path.stat().st_size > _MAX_BYTES or not _is_empty_log(path.read_bytes()):
            return False
        path.unlink()
    except OSError:
        return False
    return True


def _is_empty_log(data: bytes) -> bool:
    """Return whether the data start like a levid log and hold no row; they may be truncated."""
    if data[: len(BEGINNING)] != BEGINNING[: len(data)]:
        return False
    with contextlib.suppress(LogError):  # truncated within the head
        return not scan(memoryview(data)).chunks
    return True


def main(fd: str, parent: str, end: str, faults: str) -> None:
    """Record until the end is requested; read the rig as JSON from standard input."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)  # the supervisor requests the end
    receive_signals()
    set_process_name("levid-recorder")
    rig = RigConfig.model_validate_json(sys.stdin.buffer.read())
    shared = SharedMemory(rig, int(fd))
    RecorderProcess(rig, shared, socket.socket(fileno=int(end)), Path(faults)).run(int(parent))


if __name__ == "__main__":
    main(*sys.argv[1:])
