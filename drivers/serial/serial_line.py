"""Read and write bytes on a serial port, or on any URL of pyserial, up to a deadline."""

from __future__ import annotations

import contextlib
import os
import select
import socket
from time import perf_counter
from typing import Any

from ...config.buses import SerialBus
from ..base import LinkError
from ..bus_lock import BusLock
from ..remedies import serial_problem

_CHUNK = 4096
_WRITE_S = 0.1
_READ_S = 0.001
"""Read timeout of a port without a file descriptor. It is constant: rfc2217:// negotiates all
settings again whenever one changes."""


class SerialLine:
    """Writes and reads bytes; a failure is a LinkError that names port and cause."""

    def __init__(self, name: str, bus: SerialBus) -> None:
        self._what = f"serial {name} ({bus.port})"
        self._bus = bus
        self._port: Any = None
        self._to_close: list[Any] = []  # lost, and not closed yet
        self._fd = -1
        self._waiting = [-1]
        # The kernel locks local ports; loop:// is inside this process.
        shared = "://" in bus.port and not bus.port.startswith("loop:")
        self._lock = BusLock(f"serial {bus.place}") if shared else None

    def open(self) -> None:
        """Open the port, again if it is open; raises LinkError, also if another loop uses it."""
        import serial

        self._close_all()
        if self._lock is not None:
            self._lock.require(self._what)
        # rfc2217:// has no write timeout.
        no_write_timeout = self._bus.port.startswith("rfc2217:")
        times: dict[str, Any] = (
            {"timeout": _READ_S} if no_write_timeout else {"timeout": 0, "write_timeout": _WRITE_S}
        )
        try:
            port: Any = serial.serial_for_url(
                self._bus.port, self._bus.baud, exclusive=True, **times
            )
        except Exception as error:  # noqa: BLE001 - as in write; an unknown protocol, say
            why = serial_problem(self._bus.port, self._bus.baud, error)
            raise LinkError(f"{self._what}: cannot be opened: {why}") from None
        self._port = port
        # The latency timer of an FTDI adapter delays bytes by 16 ms by default.
        with contextlib.suppress(Exception):
            port.set_low_latency_mode(True)
        # Nagle's algorithm delays bytes until earlier ones are acknowledged: one lost answer would
        # delay 40 cycles.
        with contextlib.suppress(Exception):
            port._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        try:
            self._fd = port.fileno()
        except (OSError, AttributeError, ValueError):
            self._fd = -1  # read through pyserial
            with contextlib.suppress(Exception):
                port._socket.settimeout(_WRITE_S)  # of rfc2217://
            if port.timeout != _READ_S:
                port.timeout = _READ_S
        self._waiting = [self._fd]

    def close(self) -> None:
        """Close the port; safe to call twice."""
        self._close_all()
        if self._lock is not None:
            self._lock.release()

    def _close_all(self) -> None:
        self._close_later()
        while self._to_close:
            with contextlib.suppress(Exception):
                self._to_close.pop().close()

    def write(self, data: bytes) -> None:
        """Send bytes; raises LinkError."""
        if self._port is None:
            raise LinkError(f"{self._what}: not open")
        try:
            if self._fd >= 0:
                # The kernel buffers some 40 cycles; the loop never waits for a full buffer.
                if os.write(self._fd, data) < len(data):
                    raise BlockingIOError("send buffer full: the device reads nothing")
            else:
                self._port.write(data)
        except Exception as error:  # noqa: BLE001 - pyserial's backends raise whatever they meet
            self._fail(error)

    def read(self, deadline_s: float) -> bytes:
        """Return received bytes, waiting until `deadline_s` (perf_counter); raises LinkError.

        Empty if nothing arrives in time; 0 does not wait.
        """
        if self._port is None:
            raise LinkError(f"{self._what}: not open")
        try:
            if self._fd < 0:
                return self._read_by_pyserial(deadline_s)
            wait_s = deadline_s - perf_counter() if deadline_s else 0.0
            # select, not poll: the timeout of poll is in whole milliseconds.
            if not select.select(self._waiting, (), (), max(wait_s, 0.0))[0]:
                return b""
            data = os.read(self._fd, _CHUNK)
        except BlockingIOError:
            return b""
        except Exception as error:  # noqa: BLE001 - as above
            self._fail(error)
        if not data:
            self._fail(OSError("closed by the other end"))
        return data

    def _read_by_pyserial(self, deadline_s: float) -> bytes:
        port = self._port
        data = b""
        while not (data or port.in_waiting):
            if perf_counter() >= deadline_s:
                return b""
            data = port.read(1)
        waiting = min(port.in_waiting, _CHUNK)
        return data + port.read(waiting) if waiting else data

    def _close_later(self) -> None:
        if self._port is not None:
            self._to_close.append(self._port)
        self._port, self._fd = None, -1

    def _fail(self, error: Exception) -> None:
        # Close later: closing may take 0.3 s, and other ports still need zero force in this cycle.
        self._close_later()
        raise LinkError(f"{self._what}: lost: {error}") from None
