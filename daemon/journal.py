"""What the daemon says: lines on stderr, or entries of systemd's journal with fields."""

from __future__ import annotations

import os
import socket
import struct
import sys
from collections.abc import Callable, Mapping

_SOCKET = "/run/systemd/journal/socket"
_ERROR, _WARNING, _INFO = 3, 4, 6


class Journal:
    """Says a line at a time, from any thread; never waits, and never raises.

    Where stderr is the journal's (`JOURNAL_STREAM`), a line becomes an entry over its native
    socket, with `fields` at that moment; it is an error as long as `LEVID_FAULT` names a fault.
    """

    def __init__(self, path: str = _SOCKET) -> None:
        self._path = path
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) if _is_ours() else None
        if self._socket is not None:
            self._socket.setblocking(False)
        self.fields: Callable[[], Mapping[str, str]] = dict

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
        sys.stderr.write(f"{text}\n")
        sys.stderr.flush()


def entry(text: str, priority: int, fields: Mapping[str, str]) -> bytes:
    """Return an entry of systemd's native journal protocol; fields without a value are left out."""
    every = {"MESSAGE": text, "PRIORITY": str(priority), "SYSLOG_IDENTIFIER": "levid", **fields}
    parts = []
    for name, value in every.items():
        data = value.encode()
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
