"""Tells systemd how the daemon is: ready, alive, ending. Without systemd it says nothing."""

from __future__ import annotations

import os
import socket
import time
from collections import deque

_MOST_UNSENT = 16


class Notify:
    """sd_notify(3) over $NOTIFY_SOCKET; `alive` feeds the watchdog, twice within its time."""

    def __init__(self) -> None:
        path = os.environ.get("NOTIFY_SOCKET", "")
        self._address = f"\0{path[1:]}" if path.startswith("@") else path
        self._socket: socket.socket | None = None
        if path:
            self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_NONBLOCK)
        self._unsent: deque[str] = deque(maxlen=_MOST_UNSENT)
        own = os.environ.get("WATCHDOG_PID", str(os.getpid())) == str(os.getpid())
        watchdog_us = os.environ.get("WATCHDOG_USEC", "0") if own else "0"
        self._every_s = int(watchdog_us) * 0.5e-6 if watchdog_us.isdecimal() else 0.0
        self._fed_s = 0.0
        self._status = ""

    def ready(self) -> None:
        """Say that requests are answered."""
        self._send("READY=1")

    def stopping(self) -> None:
        """Say that the end has begun."""
        self._send("STOPPING=1")

    def status(self, text: str) -> None:
        """Say in a line what it is doing."""
        if text != self._status:
            self._status = text
            self._send(f"STATUS={text}")

    def alive(self) -> None:
        """Feed the watchdog: to be called only while the loop advances, and often."""
        self._flush()
        now_s = time.monotonic()
        if self._every_s and not self._unsent and now_s - self._fed_s >= self._every_s:
            self._fed_s = now_s
            self._send("WATCHDOG=1")

    def _send(self, text: str) -> None:
        if self._socket is not None:
            self._unsent.append(text)
            self._flush()

    def _flush(self) -> None:
        """Send what waits; a manager that is busy is told later, one that is gone never."""
        while self._unsent and self._socket is not None:
            try:
                self._socket.sendto(self._unsent[0].encode(), self._address)
            except BlockingIOError:
                return
            except OSError:
                pass
            self._unsent.popleft()
