"""Start, command, monitor and restart the recorder process from the supervisor."""

from __future__ import annotations

import base64
import json
import os
import socket
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from ..control.faults import Fault
from ..host.child_process import Child, ChildSilence, module_of
from ..host.clock_excluding_suspension import ProcessClock
from ..host.rate_limited_log import RateLimitedLog
from ..ipc.json_lines import Closed, Lines, TooLong
from ..ipc.row_ring import HUNG_S
from ..ipc.shared_status_words import ControlWords, Word
from .fault_recorder import NO_ROWS
from .log_router import Event, LogFile

_MAX_BYTES = 16 << 20
_FIRST_PAUSE_S, _LONGEST_PAUSE_S = 0.1, 60.0
"""Pause between two starts; a recorder that ran for `_STABLE_S` is restarted at once."""
_STABLE_S = 10.0
_STARTING_S = 60.0
"""Time limit for the start of a recorder, without the time it waited for a processor. On an idle
machine it needs less than 1 s."""

Log = Callable[[str], None]


class RecorderLink:
    """Keep a recorder running; the loop flies on without it.

    `files`: the files of each log in order, by tag. `failed`: the reason of each failed log.
    """

    def __init__(
        self, rig_json: bytes, shared_fd: int, control_words: ControlWords, faults: Path, log: Log
    ) -> None:
        self._child = Child("recorder", module_of("recording.recorder_process"), rig_json)
        self._shared_fd, self._control_words, self._faults, self._log = (
            shared_fd,
            control_words,
            faults,
            log,
        )
        self._lines: Lines | None = None
        self._head: Mapping[str, bytes] | None = None
        self._logs: dict[int, LogFile] = {}
        self._tags = 0
        self.files: dict[int, list[Path]] = {}
        self.failed: dict[int, str] = {}
        self.last_fault_log = ""  # last flight recording that was written
        self._log_failed = self._fault_failed = ""
        self._opened: Path | None = None  # last log opened since a flight recording failed
        self.lost = ""  # what happened to a log of this flight on the disk
        self._unrecorded = ""  # fault whose flight recording was requested and is not confirmed
        self.restarts = -1
        self._pause_s, self._restart_s, self._started_s = _FIRST_PAUSE_S, 0.0, 0.0
        self._rarely = RateLimitedLog(log)
        self._process_clock, self._beat = ProcessClock(), 0
        self._silence, self._running = ChildSilence(self._child), False
        self._hung = False  # killed, but the process has not ended yet
        self._ready_requested = self._ready_answered = 0

    @property
    def pid(self) -> int | None:
        """Process id of the recorder, None if it does not run."""
        return self._child.pid

    @property
    def gone(self) -> str:
        """Why no recorder runs; empty if one does."""
        if not self._child.running:
            return f"the recorder ended ({self._child.end}) and will be restarted"
        if self._hung:
            return "the recorder hangs, perhaps with its disk: it is restarted once it ends"
        return ""

    @property
    def problem(self) -> str:
        """Why nothing is recorded; empty if recording works."""
        return self.gone or self._log_failed or self._fault_failed

    @property
    def writing(self) -> str:
        """Path of the log that is being written; empty if there is none."""
        files = self.files.get(self._control_words[Word.WRITING], [])
        return str(files[-1]) if files else ""

    def define(self, file: LogFile) -> int:
        """Announce a log to the recorder; return the tag for its rows."""
        self._tags += 1
        self._logs[self._tags] = file
        self.files[self._tags] = []
        self._define(self._tags, file, again=False)
        return self._tags

    def forget(self) -> None:
        """Forget earlier logs, which are closed, and their errors.

        The failure of a flight recording is kept until a recording or log is written.
        """
        self._log_failed = self.lost = ""
        self._logs.clear()
        self.files.clear()
        self.failed.clear()
        # A recording of an earlier fault would now contain the wrong flight.
        self._unrecorded = ""
        self._send({"forget": self._tags})

    def request_ready(self) -> None:
        """Request that the recorder reports when it has read all rows."""
        self._ready_requested += 1
        self._send({"ready": self._ready_requested})

    @property
    def is_ready(self) -> bool:
        """Whether the present recorder answered the last `request_ready`."""
        answered = self._ready_requested == self._ready_answered
        return answered and self._child.running and not self._hung

    def fault(self, fault: Fault) -> None:
        """Request a flight recording of a fault that the loop could not log itself."""
        self._unrecorded = fault.name  # requested again if the recorder is restarted
        self._send({"fault": fault.name})

    def watch(self) -> None:
        """Process its messages; start or restart the recorder if it does not run."""
        self.receive()
        now_s = self._process_clock.update(time.monotonic())
        self._rarely.flush(now_s)
        if not self._child.running:
            if now_s >= self._restart_s:
                self._start(now_s)
            return
        beat = self._control_words[Word.RECORDER_BEAT]
        if beat != self._beat:
            self._beat, self._running, self._hung = beat, True, False
            self._silence.begin(now_s)
            if now_s - self._started_s >= _STABLE_S:
                self._pause_s, self._restart_s = _FIRST_PAUSE_S, now_s
            return
        limit_s = HUNG_S if self._running else _STARTING_S
        if self._silence.passed_s(now_s) > limit_s:
            state = "hung" if self._running else "did not start"
            self._rarely.line("hung", now_s, f"killed the recorder: it {state} for {limit_s:g} s")
            self._child.kill(0.0)  # do not wait: its disk may hang
            self._silence.begin(now_s)
            self._hung = True

    def end(self, timeout_s: float) -> None:
        """Have the recorder write the remaining rows and end; kill it after `timeout_s`."""
        self._send({"end": True})
        deadline_s = time.monotonic() + timeout_s
        while self._child.running and time.monotonic() < deadline_s:
            self.receive()
            self._child.wait(0.02)
        self.receive()
        if self._child.running:
            self._log(f"killed the recorder: it did not end within {timeout_s:g} s")
        self._child.kill()

    def _start(self, now_s: float) -> None:
        restarted = f"the recorder ended ({self._child.end}) and was restarted"
        self.restarts += 1
        self._started_s = now_s
        self._restart_s = now_s + self._pause_s
        self._pause_s = min(2 * self._pause_s, _LONGEST_PAUSE_S)
        if self._lines is not None:
            self._lines.close()
            self._lines = None
        try:
            ours, theirs = socket.socketpair()
            self._lines = Lines(ours, _MAX_BYTES, _MAX_BYTES)
            with theirs:
                self._child.start(
                    (self._shared_fd, os.getpid(), theirs.fileno(), self._faults),
                    (self._shared_fd, theirs.fileno()),
                )
        except OSError as error:
            self._rarely.line("ended", now_s, f"cannot start the recorder: {error}")
            return
        if self.restarts:
            self._rarely.line("ended", now_s, restarted)
        self._silence.begin(now_s)
        self._beat = self._control_words[Word.RECORDER_BEAT]  # of the previous recorder
        self._running = self._hung = False
        self._head = None
        for tag, file in self._logs.items():
            # Never overwrite a part that exists.
            part = file.part + len(self.files[tag])
            self._define(tag, replace(file, part=part), again=True)
        if self._unrecorded:
            self._send({"fault": self._unrecorded})
        self._ready_answered = 0
        if self._ready_requested:
            self._send({"ready": self._ready_requested})

    def _define(self, tag: int, file: LogFile, again: bool) -> None:
        # All logs of a session have the same attachments: send them once.
        if file.attachments is not self._head:
            self._head = file.attachments
            head = {n: base64.b64encode(data).decode() for n, data in file.attachments.items()}
            self._send({"head": head})
        metadata = dict(file.metadata)
        path, part = str(file.path), file.part
        self._send({"log": tag, "path": path, "metadata": metadata, "part": part, "again": again})

    def _send(self, message: Mapping[str, Any]) -> None:
        if self._lines is None:
            return
        try:
            self._lines.put(message)
        except Closed:
            return  # it ended: `_start` sends the next one all that is needed

    def receive(self) -> None:
        """Process the messages of the recorder."""
        if self._lines is None:
            return
        try:
            self._lines.flush()
            self._lines.receive()
            for line in self._lines.lines():
                self._process(json.loads(line))
        except (Closed, TooLong, ValueError):
            return

    def _process(self, message: Mapping[str, Any]) -> None:
        if message["event"] == "ready":
            self._ready_answered = int(message["ready"])
            return
        if message["event"] == "fault":
            self._unrecorded = "" if message["fault"] == self._unrecorded else self._unrecorded
            path, why = message["path"], message["why"]
            if path:
                self.last_fault_log, self._log_failed, self._fault_failed = path, "", ""
            elif why != NO_ROWS:
                self._fault_failed = f"flight recording of {message['fault']}: {why}"
                self._opened = None
            result = "; ".join(filter(None, (path, why))) if path else f"not written: {why}"
            self._log(f"flight recording of {message['fault']}: {result}")
            return
        tag, path = int(message["log"]), Path(message["path"])
        if message["event"] == Event.OPENED:
            files = self.files.get(tag, [])
            if path not in files:  # a restarted recorder reopens a file without rows
                files.append(path)
            self._opened = path
        elif message["event"] == Event.CLOSED:
            # Only a log opened since the failure shows that the disk works again.
            if path == self._opened and tag not in self.failed:
                self._fault_failed = ""
        elif message["event"] in (Event.DELETED, Event.LOST, Event.RESTORED):
            self._lose(Event(message["event"]), tag, path, str(message["why"]))
        elif message["event"] == Event.FAILED and tag in self.files:
            self._log_failed = self.failed.setdefault(tag, str(message["why"]))
            self._log(f"recording stopped, the flight goes on: {message['why']}")

    def _lose(self, event: Event, tag: int, path: Path, why: str) -> None:
        """Process that a log was deleted, lost or restored while it was written."""
        if event is Event.RESTORED and not why:
            self._log(f"{path}: restored, with all rows before it was deleted")
            files = self.files.get(tag, [])
            if path not in files:  # another file had taken its place
                files.append(path)
            return
        text = why if event is not Event.RESTORED else f"{path}: deleted, and not restored: {why}"
        self._log(text)
        self.lost = text
        if event is not Event.DELETED and tag in self.files:
            self.failed.setdefault(tag, text)
