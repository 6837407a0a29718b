"""One serial port as bytes: opened by any URL that pyserial knows, read up to a deadline."""

from __future__ import annotations

import contextlib
import os
import select
from time import perf_counter
from typing import Any

from ...config.buses import SerialBus
from ..base import LinkError

_CHUNK = 4096


class SerialLine:
    """Writes bytes and waits for bytes; what fails is a LinkError that names port and cause."""

    def __init__(self, name: str, bus: SerialBus) -> None:
        self._what = f"serial {name} ({bus.port})"
        self._bus = bus
        self._port: Any = None
        self._fd = -1
        self._waiting = [-1]

    def open(self) -> None:
        """Open the port, anew if it was open; raises LinkError."""
        import serial

        self.close()
        try:
            port = serial.serial_for_url(
                self._bus.port, self._bus.baud, timeout=0, write_timeout=0.1, exclusive=True
            )
        except (OSError, ValueError, serial.SerialException) as error:
            raise LinkError(f"{self._what}: cannot be opened: {error}") from None
        self._port = port
        # An adapter that holds bytes back for its latency timer would cost 16 ms a cycle.
        with contextlib.suppress(Exception):
            port.set_low_latency_mode(True)
        try:
            self._fd = port.fileno()
        except (OSError, AttributeError, ValueError):
            self._fd = -1  # rfc2217://, say: pyserial's own reading has to do
        self._waiting = [self._fd]

    def close(self) -> None:
        """Let go of the port; safe to call twice."""
        port, self._port, self._fd = self._port, None, -1
        if port is not None:
            with contextlib.suppress(Exception):
                port.close()

    def write(self, data: bytes) -> None:
        """Send bytes; raises LinkError."""
        if self._port is None:
            raise LinkError(f"{self._what}: gone")
        try:
            if self._fd >= 0:
                sent = os.write(self._fd, data)
                if sent == len(data):
                    return
                data = data[sent:]
            self._port.write(data)
        except Exception as error:  # noqa: BLE001 - pyserial's backends raise whatever they meet
            self._lost(error)

    def read(self, deadline_s: float) -> bytes:
        """Return what has come, waiting until `deadline_s` (perf_counter); raises LinkError.

        Nothing at all is returned where nothing came in time.
        """
        if self._port is None:
            raise LinkError(f"{self._what}: gone")
        try:
            if self._fd < 0:
                self._port.timeout = max(deadline_s - perf_counter(), 0.0)
                first: bytes = self._port.read(1)
                return first + self._port.read(self._port.in_waiting) if first else b""
            wait_s = deadline_s - perf_counter() if deadline_s else 0.0
            # Not poll: its timeout is in whole milliseconds, rounded up.
            if not select.select(self._waiting, (), (), max(wait_s, 0.0))[0]:
                return b""
            data = os.read(self._fd, _CHUNK)
        except BlockingIOError:
            return b""
        except Exception as error:  # noqa: BLE001 - as above
            self._lost(error)
        if not data:
            self._lost(OSError("the other end hung up"))
        return data

    def _lost(self, error: Exception) -> None:
        self.close()
        raise LinkError(f"{self._what}: lost: {error}") from None
