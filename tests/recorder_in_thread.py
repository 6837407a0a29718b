"""A recorder in a thread, with the supervisor's end of its conversation."""

from __future__ import annotations

import json
import os
import socket
import threading
from pathlib import Path
from typing import Any

from levid.config.rig import load_rig
from levid.config.shipped import shipped
from levid.daemon.ipc.json_lines import Lines
from levid.daemon.ipc.shared_memory import SharedMemory
from levid.daemon.recording.recorder_process import RecorderProcess
from levid.log.reader import read_log

METADATA = {"kind": "record", "name": "z"}


class Recording:
    """A recorder in a thread, and the supervisor's end of its conversation."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.rig = folder, load_rig(shipped("rigs/loopback.yaml"))
        self.shared = SharedMemory(self.rig)
        self.ours, self.theirs = socket.socketpair()
        self._lines = Lines(self.ours, 1 << 20, 1 << 20)
        self._thread: threading.Thread | None = None
        self.events: list[dict[str, Any]] = []

    def start(self) -> None:
        """Start the recorder, which reads the rows and messages that are there."""
        made = RecorderProcess(self.rig, self.shared, self.theirs, self.folder / "faults")
        self._thread = threading.Thread(target=made.run, args=(os.getppid(),))
        self._thread.start()

    def finish(self) -> None:
        """Have the recorder write what is left, and wait for its end."""
        self.tell({"end": True})
        assert self._thread is not None
        self._thread.join(30.0)
        assert not self._thread.is_alive()
        self.event("")

    def tell(self, *messages: dict[str, object]) -> None:
        for message in messages:
            self._lines.put(message)

    def define(self, tag: int) -> None:
        path = str(self.folder / f"{tag}.mcap")
        file = {"path": path, "metadata": METADATA, "part": 1, "again": False}
        self.tell({"log": tag, **file})

    def write(self, *tags: int) -> None:
        """Append rows with these tags."""
        ring, count = self.shared.ring, len(tags)
        ring.tags[ring.head : ring.head + count] = tags
        ring.rows["cycle"][ring.head : ring.head + count] = range(ring.head, ring.head + count)
        ring.head += count

    def event(self, kind: str, **content: object) -> bool:
        """Return whether the recorder has sent an event of this kind and content."""
        while self._lines.receive():
            self.events += map(json.loads, self._lines.lines())
        wanted = {"event": kind, **content}
        return any(wanted.items() <= event.items() for event in self.events)

    def cycles(self, name: str) -> list[int]:
        """Return the cycles in a log."""
        return list(read_log(self.folder / name).rows["cycle"])

    def close(self) -> None:
        if self._thread is not None and self._thread.is_alive():
            self.finish()
        for end in (self.ours, self.theirs):
            end.close()
        self.shared.close()
