"""What the daemon says: lines on stderr, or entries of systemd's journal with fields."""

from __future__ import annotations

import contextlib
import os
import queue
import socket
import struct
import sys
import threading
from collections.abc import Callable, Mapping

from ..control.faults import Fault
from ..ipc.control_words import Board

_SOCKET = "/run/systemd/journal/socket"
_ERROR, _WARNING, _INFO = 3, 4, 6
_STDERR = 2
_MOST_WAITING = 1000
_LAST_WORDS_S = 1.0


class Journal:
    """Says a line at a time, from any thread; never waits, and never raises.

    Where stderr is the journal's (`JOURNAL_STREAM`), a line becomes an entry over its native
    socket, with `fields` at that moment; it is an error as long as `LEVID_FAULT` names a fault.
    What stderr does not take, a full disk, a terminal that was stopped, waits in a thread of its
    own and is lost beyond a thousand lines.
    """

    def __init__(self, path: str = _SOCKET) -> None:
        self._path = path
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) if _is_ours() else None
        if self._socket is not None:
            self._socket.setblocking(False)
        self.fields: Callable[[], Mapping[str, str]] = dict
        self._lines: queue.Queue[str | None] = queue.Queue(_MOST_WAITING)
        self._thread = threading.Thread(target=self._write, name="levid-journal", daemon=True)
        self._thread.start()

    def say(self, text: str) -> None:
        """Say one line."""
        if self._socket is not None:
            fields = self.fields()
            calm = _WARNING if text.startswith("warning:") else _INFO
            priority = _ERROR if fields.get("LEVID_FAULT") else calm
            try:
                self._socket.sendto(entry(text, priority, fields), self._path)
            except OSError:
                pass  # a journal that is busy or gone gets the bare line
            else:
                return
        with contextlib.suppress(queue.Full):
            self._lines.put_nowait(text)

    def close(self) -> None:
        """Give what was said a moment to get out."""
        with contextlib.suppress(queue.Full):
            self._lines.put_nowait(None)
        self._thread.join(_LAST_WORDS_S)

    def _write(self) -> None:
        while (text := self._lines.get()) is not None:
            # Past sys.stderr: whoever waits in there at the end of the process would hold it up.
            with contextlib.suppress(OSError):
                data = f"{text}\n".encode(errors="backslashreplace")
                while data:
                    data = data[os.write(_STDERR, data) :]


def moment(rig: str, board: Board) -> dict[str, str]:
    """Return the fields that every entry carries; empty where there is nothing."""
    fault = board.fault
    return {
        "LEVID_RIG": rig,
        "LEVID_STATE": board.state.name,
        "LEVID_FAULT": fault.name if fault is not Fault.NONE else "",
    }


def entry(text: str, priority: int, fields: Mapping[str, str]) -> bytes:
    """Return an entry of systemd's native journal protocol; fields without a value are left out."""
    every = {"MESSAGE": text, "PRIORITY": str(priority), "SYSLOG_IDENTIFIER": "levid", **fields}
    parts = []
    for name, value in every.items():
        data = value.encode(errors="backslashreplace")
        if b"\n" in data:
            parts.append(name.encode() + b"\n" + struct.pack("<Q", len(data)) + data + b"\n")
        elif data:
            parts.append(name.encode() + b"=" + data + b"\n")
    return b"".join(parts)


def _is_ours() -> bool:
    """Return whether stderr leads to the journal: it may have been redirected."""
    try:
        found = os.fstat(sys.stderr.fileno())
    except (OSError, ValueError):
        return False
    return os.environ.get("JOURNAL_STREAM", "") == f"{found.st_dev}:{found.st_ino}"
