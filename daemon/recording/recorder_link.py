"""The supervisor's side of the recorder: says what to write, hears what was, starts it anew."""

from __future__ import annotations

import base64
import json
import math
import os
import socket
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from ..control.faults import Fault
from ..host.child_process import Child, ChildSilence, module_of
from ..host.process_clock import Awake
from ..ipc.control_words import Board, Word
from ..ipc.json_lines import Closed, Lines, TooLong
from ..ipc.row_ring import HUNG_S
from .fault_recorder import NO_ROWS
from .log_router import Event, LogFile

_MOST_BYTES = 16 << 20
_FIRST_PAUSE_S, _LONGEST_PAUSE_S = 0.1, 60.0
"""From one start to the next: a recorder that had lived for a while is started anew at once."""
_LIVED_S = 10.0
_SAID_AGAIN_S = 60.0
_STARTING_S = 60.0
"""How long a recorder may take to begin, not counting the time for which it got no processor; on an
idle machine it takes less than one."""

Say = Callable[[str], None]


class RecorderLink:
    """Keeps a recorder running; whatever becomes of it, the loop flies on.

    `files` are the files of each log, in order, `failed` what went wrong with it.
    """

    def __init__(
        self, rig_json: bytes, shared_fd: int, board: Board, faults: Path, say: Say
    ) -> None:
        self._child = Child("recorder", module_of("recording.recorder_process"), rig_json)
        self._shared_fd, self._board, self._faults, self._say = shared_fd, board, faults, say
        self._lines: Lines | None = None
        self._head: Mapping[str, bytes] | None = None
        self._logs: dict[int, LogFile] = {}
        self._tags = 0
        self.files: dict[int, list[Path]] = {}
        self.failed: dict[int, str] = {}
        self.last_fault_log = ""  # the last one that was written: later ones may have failed
        self._log_failed = self._fault_failed = ""
        self._opened: Path | None = None  # the log begun since a flight recording failed
        self._untold = ""  # the fault that a flight recording was asked for, until there is one
        self.restarts = -1
        self._pause_s, self._again_s, self._started_s = _FIRST_PAUSE_S, 0.0, 0.0
        self._said: dict[str, tuple[float, int]] = {}  # when, and how often it was held back since
        self._awake, self._beat = Awake(), 0
        self._silence, self._begun = ChildSilence(self._child), False
        self._hangs = False  # and was killed, but the kernel does not let go of it
        self._ready_asked = self._ready_answered = 0

    @property
    def pid(self) -> int | None:
        """The recorder's process."""
        return self._child.pid

    @property
    def problem(self) -> str:
        """Why nothing is being recorded, in words; empty where all is well."""
        if not self._child.running:
            return f"the recorder is gone ({self._child.end}) and will be started anew"
        if self._hangs:
            return (
                "the recorder hangs, and so does its disk perhaps: it is started anew once it ends"
            )
        return self._log_failed or self._fault_failed

    def define(self, file: LogFile) -> int:
        """Return the tag of rows that are to go into this log."""
        self._tags += 1
        self._logs[self._tags] = file
        self.files[self._tags] = []
        self._define(self._tags, file, again=False)
        return self._tags

    def forget(self) -> None:
        """Begin anew: earlier logs are closed, and so are their errors.

        That a flight recording failed stands until one, or a log, is written.
        """
        self._log_failed = ""
        self._logs.clear()
        self.files.clear()
        self.failed.clear()
        # What could not be told of an earlier fault by now would be a recording of this flight.
        self._untold = ""
        self._send({"forget": self._tags})

    def ask_ready(self) -> None:
        """Ask the recorder whether it lives and has taken all rows that there are."""
        self._ready_asked += 1
        self._send({"ready": self._ready_asked})

    @property
    def is_ready(self) -> bool:
        """Whether the recorder that runs now has answered that it is."""
        answered = self._ready_asked == self._ready_answered
        return answered and self._child.running and not self._hangs

    def fault(self, fault: Fault) -> None:
        """Have a flight recording written for a fault that the loop could not log itself."""
        self._untold = fault.name  # whatever becomes of the recorder meanwhile
        self._send({"fault": fault.name})

    def watch(self) -> None:
        """Hear what it has to say; start it, or start it anew, where it is not there."""
        self.hear()
        now_s = self._awake.look(time.monotonic())
        if not self._child.running:
            if now_s >= self._again_s:
                self._start(now_s)
            return
        beat = self._board[Word.RECORDER_BEAT]
        if beat != self._beat:
            self._beat, self._begun, self._hangs = beat, True, False
            self._silence.begin(now_s)
            if now_s - self._started_s >= _LIVED_S:  # one beat is no life: it may die of each start
                self._pause_s, self._again_s = _FIRST_PAUSE_S, now_s
            return
        most_s = HUNG_S if self._begun else _STARTING_S
        if self._silence.passed_s(now_s) > most_s:
            what = "hangs" if self._begun else "does not begin"
            self._say_seldom(now_s, "hung", f"the recorder {what} for {most_s:g} s: it is killed")
            self._child.kill(0.0)  # its end is noticed as any is; nothing waits for a disk here
            self._silence.begin(now_s)
            self._hangs = True

    def end(self, patience_s: float) -> None:
        """Let it write what is left and end."""
        self._send({"end": True})
        give_up_s = time.monotonic() + patience_s
        while self._child.running and time.monotonic() < give_up_s:
            self.hear()
            self._child.wait(0.02)
        self.hear()
        if self._child.running:
            self._say(f"the recorder did not end within {patience_s:g} s: it is killed")
        self._child.kill()

    def _start(self, now_s: float) -> None:
        gone = f"the recorder is gone ({self._child.end}): it is started anew"
        self.restarts += 1
        self._started_s = now_s
        self._again_s = now_s + self._pause_s
        self._pause_s = min(2 * self._pause_s, _LONGEST_PAUSE_S)
        if self._lines is not None:
            self._lines.close()
            self._lines = None
        try:
            ours, theirs = socket.socketpair()
            self._lines = Lines(ours, _MOST_BYTES, _MOST_BYTES)
            with theirs:
                self._child.start(
                    (self._shared_fd, os.getpid(), theirs.fileno(), self._faults),
                    (self._shared_fd, theirs.fileno()),
                )
        except OSError as error:
            self._say_seldom(now_s, "gone", f"the recorder cannot be started: {error}")
            return
        if self.restarts:
            self._say_seldom(now_s, "gone", gone)
        self._silence.begin(now_s)
        self._beat = self._board[Word.RECORDER_BEAT]  # the last one's
        self._begun = self._hangs = False
        self._head = None
        for tag, file in self._logs.items():
            # A part that was begun is never written over.
            part = file.part + len(self.files[tag])
            self._define(tag, replace(file, part=part), again=True)
        if self._untold:
            self._send({"fault": self._untold})
        self._ready_answered = 0
        if self._ready_asked:
            self._send({"ready": self._ready_asked})

    def _say_seldom(self, now_s: float, about: str, what: str) -> None:
        """Say it once a minute at most, and then how often it was not said."""
        said_s, unsaid = self._said.get(about, (-math.inf, 0))
        if now_s - said_s < _SAID_AGAIN_S:
            self._said[about] = said_s, unsaid + 1
            return
        self._said[about] = now_s, 0
        self._say(f"{what} ({unsaid} more since this was said last)" if unsaid else what)

    def _define(self, tag: int, file: LogFile, again: bool) -> None:
        # The logs of a session have their attachments in common: they are sent once.
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
            return  # it is dead: the next one is told all that still matters

    def hear(self) -> None:
        """Take in what the recorder has told."""
        if self._lines is None:
            return
        try:
            self._lines.flush()
            self._lines.receive()
            for line in self._lines.lines():
                self._take(json.loads(line))
        except (Closed, TooLong, ValueError):
            return

    def _take(self, message: Mapping[str, Any]) -> None:
        if message["event"] == "ready":
            self._ready_answered = int(message["ready"])
            return
        if message["event"] == "fault":
            self._untold = "" if message["fault"] == self._untold else self._untold
            path, why = message["path"], message["why"]
            if path:
                self.last_fault_log, self._log_failed, self._fault_failed = path, "", ""
            elif why != NO_ROWS:  # then nothing failed: there was nothing to record
                self._fault_failed = f"flight recording of {message['fault']}: {why}"
                self._opened = None
            what = "; ".join(filter(None, (path, why))) if path else f"could not be written: {why}"
            self._say(f"flight recording of {message['fault']}: {what}")
            return
        tag, path = int(message["log"]), Path(message["path"])
        if message["event"] == Event.OPENED:
            files = self.files.get(tag, [])
            if path not in files:  # one that held no row was begun anew
                files.append(path)
            self._opened = path
        elif message["event"] == Event.CLOSED:
            # One that was begun before may need but its end, for which there is room sooner.
            if path == self._opened and tag not in self.failed:
                self._fault_failed = ""
        elif message["event"] == Event.FAILED and tag in self.files:
            self._log_failed = self.failed.setdefault(tag, str(message["why"]))
            self._say(f"recording stopped, the flight goes on: {message['why']}")
