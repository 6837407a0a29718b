"""Log lines to stderr, or to the systemd journal with fields."""

from __future__ import annotations

import contextlib
import os
import queue
import socket
import struct
import sys
import threading
from collections.abc import Callable, Mapping

from ...config.escaping import visible
from ..control.faults import Fault
from ..ipc.shared_status_words import ControlWords

_SOCKET = "/run/systemd/journal/socket"
_ERROR, _WARNING, _INFO = 3, 4, 6
_STDERR = 2
_MAX_QUEUED = 1000
_CLOSE_S = 1.0


class Journal:
    """Log lines from any thread; never waits and never raises.

    If stderr leads to the journal (`JOURNAL_STREAM`), a line is sent to its native socket with the
    current `fields`; its priority is error while `LEVID_FAULT` is set. Otherwise a separate thread
    writes to stderr, which may block (full disk, stopped terminal); lines beyond a thousand are
    lost.
    """

    def __init__(self, path: str = _SOCKET) -> None:
        self._path = path
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) if _is_ours() else None
        if self._socket is not None:
            self._socket.setblocking(False)
        self.fields: Callable[[], Mapping[str, str]] = dict
        self._lines: queue.Queue[str | None] = queue.Queue(_MAX_QUEUED)
        self._thread = threading.Thread(target=self._write, name="levid-journal", daemon=True)
        self._thread.start()

    def log(self, text: str) -> None:
        """Log one line; the prefix `warning:` gives it that priority.

        Further lines of a text are indented: none of them looks like another entry.
        """
        text = visible(text).replace("\n", "\n  ")
        if self._socket is not None:
            fields = self.fields()
            default = _WARNING if text.startswith("warning:") else _INFO
            priority = _ERROR if fields.get("LEVID_FAULT") else default
            try:
                self._socket.sendto(entry(text, priority, fields), self._path)
            except OSError:
                pass  # journal busy or stopped: write the plain line to stderr
            else:
                return
        with contextlib.suppress(queue.Full):
            self._lines.put_nowait(text)

    def close(self) -> None:
        """Wait at most a second until queued lines are written."""
        with contextlib.suppress(queue.Full):
            self._lines.put_nowait(None)
        self._thread.join(_CLOSE_S)

    def _write(self) -> None:
        while (text := self._lines.get()) is not None:
            # Not through sys.stderr: blocked in there, it would delay the end of the process.
            with contextlib.suppress(OSError):
                data = f"{text}\n".encode(errors="backslashreplace")
                while data:
                    data = data[os.write(_STDERR, data) :]


def moment(rig: str, control_words: ControlWords) -> dict[str, str]:
    """Return the fields of every entry; empty values are left out of the entry."""
    fault = control_words.fault
    return {
        "LEVID_RIG": rig,
        "LEVID_STATE": control_words.state.name,
        "LEVID_FAULT": fault.name if fault is not Fault.NONE else "",
    }


def entry(text: str, priority: int, fields: Mapping[str, str]) -> bytes:
    """Encode an entry in systemd's native journal protocol; omit fields without a value."""
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
    """Return whether stderr leads to the journal and is not redirected."""
    try:
        found = os.fstat(sys.stderr.fileno())
    except (OSError, ValueError):
        return False
    return os.environ.get("JOURNAL_STREAM", "") == f"{found.st_dev}:{found.st_ino}"
