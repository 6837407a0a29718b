"""The recorder's process: rows from shared memory into logs; the loop never knows of it."""

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
from dataclasses import replace
from pathlib import Path
from typing import Any

from ...config.rig import RigConfig
from ...log.errors import LogError
from ...log.mcap_scan import scan
from ...log.writer import BEGINNING
from ..control.faults import Fault
from ..host.fsync_worker import Syncer
from ..host.real_time_scheduling import call_me
from ..ipc.control_words import Word
from ..ipc.json_lines import Closed, Lines
from ..ipc.row_ring import NO_LOG
from ..ipc.shared_memory import Shared
from .fault_recorder import FaultLog
from .log_router import BLOCK, Event, LogFile, Rotation, Scribe
from .session_logs import attachments

_POLL_S = 0.01
_SYNCING_S = 5.0
_MOST_BYTES = 16 << 20
_WITHOUT_ROWS_S = 1.0
_UNKNOWN_S = 1.0


class RecorderProcess:
    """Follows the ring until it is told to end, or until supervisor and loop are both gone."""

    def __init__(self, rig: RigConfig, shared: Shared, end: socket.socket, faults: Path) -> None:
        self._board, self._ring = shared.board, shared.ring
        self._lines = Lines(end, _MOST_BYTES, _MOST_BYTES)
        self._syncer = Syncer()
        self._logs: dict[int, LogFile] = {}
        self._head: Mapping[str, bytes] = {}
        self._tags: dict[Path, int] = {}  # of the logs at hand
        self._fault_logs: dict[Path, str] = {}  # the last one, and its fault
        self._ready = 0  # the last question whether it is, 0 where it was answered
        self._ending = False
        self._closed = NO_LOG  # tag of the last log that the supervisor has forgotten
        self._failed = NO_LOG  # tag of the last log that the scribe failed with
        self._asked: list[Fault] = []  # whose recordings have to wait for the scribe
        self._switching = False  # the scribe is in the middle of its work
        rotation = Rotation(
            int(rig.recording.rotate_mb * 1e6), int(rig.recording.rotate_s * rig.rate_hz)
        )
        self._scribe = Scribe(self._ring, rig.rate_hz, self._log_of, self._tell, rotation)
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
            self._tell_fault,
        )
        self._scribe.dropped = self._board[Word.DROPPED]  # of those before this one
        # A recorder that died left rows behind that were taken and are in no file.
        self._ring.tail = self._ring.durable
        # What it is told first may be that the loop is dead, and what is left of its rows to write.
        self._scribe.epoch_ns = self._faults.epoch_ns = self._board[Word.EPOCH_NS]
        self._faults.resume(self._board[Word.FAULTS_SEEN], self._ring.tail)

    def run(self, parent: int) -> None:
        """Record."""
        words = self._board.words
        quiet_since_s, cycle = time.monotonic(), words[Word.CYCLE]
        while True:
            self._hear(0.0 if self._ring.waiting >= BLOCK else _POLL_S)
            self._scribe.epoch_ns = self._faults.epoch_ns = words[Word.EPOCH_NS]
            log = words[Word.LOG]
            taken = self._scribe.work()
            if not len(taken.rows) and self._scribe.tag not in (NO_LOG, log):
                self._scribe.finish()  # its last row is here: on a dead bus no others come
            self._faults.see(taken)
            if self._faults.nothing_due:
                words[Word.FAULTS_SEEN] = self._ring.tail
            self._sync()
            words[Word.DROPPED] = self._scribe.dropped
            words[Word.WRITING] = self._scribe.tag
            words[Word.RECORDER_BEAT] += 1
            if self._ready and self._ring.waiting < BLOCK:
                self._say({"event": "ready", "ready": self._ready})
                self._ready = 0
            if len(taken.rows):
                continue
            if os.getppid() == parent:
                if self._ending:
                    break
                continue
            # Alone with the loop: it stops by itself, and its last rows are the story.
            if words[Word.CYCLE] != cycle:
                quiet_since_s, cycle = time.monotonic(), words[Word.CYCLE]
            elif time.monotonic() - quiet_since_s > _WITHOUT_ROWS_S:
                break
        self._scribe.finish()
        self._faults.finish()
        self._syncer.finish(_SYNCING_S)
        self._sync()
        words[Word.WRITING] = self._scribe.tag

    def _sync(self) -> None:
        self._syncer.offer(self._scribe.writer)
        for path, why in self._syncer.failures():
            if path in self._fault_logs:
                self._say(
                    {"event": "fault", "fault": self._fault_logs[path], "path": "", "why": why}
                )
            else:
                self._tell_log(Event.FAILED, self._tags.get(path, self._scribe.tag), path, why)

    def _hear(self, wait_s: float) -> None:
        """Do what the supervisor says; wait for it for `wait_s` at most."""
        while self._asked and not self._switching:
            self._record(self._asked.pop(0))
        try:
            ready, _, _ = select.select([self._lines.socket], [], [], wait_s)
            if ready:
                self._lines.receive()
            for line in self._lines.lines():
                self._obey(json.loads(line))
        except Closed:
            # It is dead, or dying: what remains is to see whether rows still come.
            time.sleep(wait_s)

    def _obey(self, message: Mapping[str, Any]) -> None:
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
            # Not those of the flight before: where a recorder was just started, the ring has rows
            # of theirs still.
            before, self._closed = self._closed, int(message["forget"])
            self._logs = {tag: log for tag, log in self._logs.items() if tag > before}
            self._tags = {path: tag for path, tag in self._tags.items() if tag > before}
            self._scribe.forget_errors()
        if "fault" in message:
            fault = Fault[message["fault"]]
            if self._switching:
                self._asked.append(fault)
            else:
                self._record(fault)
        if "ready" in message:
            self._ready = int(message["ready"])
        if "end" in message:
            self._ending = True

    def _record(self, fault: Fault) -> None:
        """Record a fault of a loop that can write no row of it."""
        while len(self._scribe.work().rows):
            pass
        self._scribe.finish()
        self._faults.finish()
        self._faults.write(fault)

    def _log_of(self, tag: int) -> LogFile | None:
        give_up_s = time.monotonic() + _UNKNOWN_S
        self._switching = True  # what it is told meanwhile must not have the scribe work
        try:
            while tag not in self._logs and time.monotonic() < give_up_s:
                self._hear(_POLL_S)
        finally:
            self._switching = False
        if self._failed <= self._closed < tag:
            # The last rows of a flight that is over may fail after it was forgotten.
            self._scribe.forget_errors()
        return self._logs.get(tag)

    def _tell(self, event: Event, tag: int, path: Path, why: str) -> None:
        if event is Event.OPENED:
            self._tags[path] = tag
            if tag in self._logs:  # should its rows come again after others, they go on in the next
                log = self._logs[tag]
                self._logs[tag] = replace(log, part=log.part + 1)
        elif event is Event.CLOSED:
            self._syncer.whole(path)
        elif event is Event.FAILED:
            self._failed = tag
        self._tell_log(event, tag, path, why)

    def _tell_log(self, event: Event, tag: int, path: Path, why: str) -> None:
        self._say({"event": event, "log": tag, "path": str(path), "why": why})

    def _tell_fault(self, fault: Fault, path: str, why: str) -> None:
        if path:
            self._fault_logs = {Path(path): fault.name}
            self._syncer.whole(Path(path))
        self._say({"event": "fault", "fault": fault.name, "path": path, "why": why})

    def _say(self, message: Mapping[str, Any]) -> None:
        with contextlib.suppress(Closed):
            self._lines.put(message)


def without_empty_part(file: LogFile) -> LogFile:
    """Take away parts that a recorder which died has begun and that hold no row: they are no logs.

    That is the part before, or one of which it told nobody. What else there is stays: the log goes
    on in the next part that is free.
    """
    while file.path_of(file.part).exists() and not _taken_away(file.path_of(file.part)):
        file = replace(file, part=file.part + 1)
    if file.part > 1 and _taken_away(file.path_of(file.part - 1)):
        file = replace(file, part=file.part - 1)
    return file


def _taken_away(path: Path) -> bool:
    """Remove a log of ours without rows, whole or cut off; return whether it was one."""
    try:
        if path.stat().st_size > _MOST_BYTES or not _is_empty_log(path.read_bytes()):
            return False
        path.unlink()
    except OSError:
        return False
    return True


def _is_empty_log(data: bytes) -> bool:
    """Return whether this is what our writer begins with, and no row: however short, it is ours."""
    if data[: len(BEGINNING)] != BEGINNING[: len(data)]:
        return False
    with contextlib.suppress(LogError):  # not all of its head got into the file
        return not scan(memoryview(data)).chunks
    return True


def main(fd: str, parent: str, end: str, faults: str) -> None:
    """Record until told to end; the rig comes as JSON on standard input."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)  # the supervisor says when it is over
    call_me("levid-recorder")
    rig = RigConfig.model_validate_json(sys.stdin.buffer.read())
    shared = Shared(rig, int(fd))
    RecorderProcess(rig, shared, socket.socket(fileno=int(end)), Path(faults)).run(int(parent))


if __name__ == "__main__":
    main(*sys.argv[1:])
