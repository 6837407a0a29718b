"""Notify systemd that the daemon is ready, alive or ending; without systemd do nothing."""

from __future__ import annotations

import os
import socket
import time
from collections import deque

from ...config.escaping import one_line

_MAX_UNSENT = 16


class Notify:
    """Send sd_notify(3) messages to $NOTIFY_SOCKET; `alive` resets the watchdog twice a period."""

    def __init__(self) -> None:
        path = os.environ.get("NOTIFY_SOCKET", "")
        self._address = f"\0{path[1:]}" if path.startswith("@") else path
        self._socket: socket.socket | None = None
        if path:
            self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_NONBLOCK)
        self._unsent: deque[str] = deque(maxlen=_MAX_UNSENT)
        own = os.environ.get("WATCHDOG_PID", str(os.getpid())) == str(os.getpid())
        watchdog_us = os.environ.get("WATCHDOG_USEC", "0") if own else "0"
        self._interval_s = int(watchdog_us) * 0.5e-6 if watchdog_us.isdecimal() else 0.0
        self._alive_s = 0.0
        self._status = ""

    def ready(self) -> None:
        """Report that requests are answered."""
        self._send("READY=1")

    def stopping(self) -> None:
        """Report that the daemon is ending."""
        self._send("STOPPING=1")

    def status(self, text: str) -> None:
        """Report the present activity in one line."""
        if text != self._status:
            self._status = text
            self._send(f"STATUS={one_line(text)}")  # a line break would begin another message

    def alive(self) -> None:
        """Reset the watchdog; call often, but only while the loop advances."""
        self._flush()
        now_s = time.monotonic()
        due = now_s - self._alive_s >= self._interval_s
        if self._interval_s and not self._unsent and due:
            self._alive_s = now_s
            self._send("WATCHDOG=1")

    def _send(self, text: str) -> None:
        if self._socket is not None:
            self._unsent.append(text)
            self._flush()

    def _flush(self) -> None:
        """Send queued messages; retry later if systemd is busy, drop them if it has ended."""
        while self._unsent and self._socket is not None:
            try:
                self._socket.sendto(self._unsent[0].encode(), self._address)
            except BlockingIOError:
                return
            except OSError:
                pass
            self._unsent.popleft()
