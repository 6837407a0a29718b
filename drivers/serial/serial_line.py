"""One serial port as bytes: opened by any URL that pyserial knows, read up to a deadline."""

from __future__ import annotations

import contextlib
import os
import select
import socket
from time import perf_counter
from typing import Any

from ...config.buses import SerialBus
from ..base import LinkError
from ..bus_lock import Claim

_CHUNK = 4096
_WRITE_S = 0.1
_SLICE_S = 0.001
"""How long a port without a descriptor is waited for at a time. It stays the same: some, such as
rfc2217://, negotiate all their settings anew whenever one changes."""


class SerialLine:
    """Writes bytes and waits for bytes; what fails is a LinkError that names port and cause."""

    def __init__(self, name: str, bus: SerialBus) -> None:
        self._what = f"serial {name} ({bus.port})"
        self._bus = bus
        self._port: Any = None
        self._aside: list[Any] = []  # lost, and not closed yet
        self._fd = -1
        self._waiting = [-1]
        # A port of this machine the kernel opens for one alone; loop:// is of this process.
        shared = "://" in bus.port and not bus.port.startswith("loop:")
        self._claim = Claim(f"serial {bus.place}") if shared else None

    def open(self) -> None:
        """Open the port, anew if it was open; raises LinkError, where another loop has it too."""
        import serial

        self._let_go()
        if self._claim is not None:
            self._claim.require(self._what)
        # rfc2217:// knows no time to write within.
        apart = self._bus.port.startswith("rfc2217:")
        times: dict[str, Any] = (
            {"timeout": _SLICE_S} if apart else {"timeout": 0, "write_timeout": _WRITE_S}
        )
        try:
            port: Any = serial.serial_for_url(
                self._bus.port, self._bus.baud, exclusive=True, **times
            )
        except Exception as error:  # noqa: BLE001 - as in write; an unknown protocol, say
            raise LinkError(f"{self._what}: cannot be opened: {error}") from None
        self._port = port
        # An adapter that holds bytes back for its latency timer would cost 16 ms a cycle.
        with contextlib.suppress(Exception):
            port.set_low_latency_mode(True)
        # TCP would hold a cycle's bytes back until the last one's are acknowledged: one answer that
        # is lost would be the silence of forty.
        with contextlib.suppress(Exception):
            port._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        try:
            self._fd = port.fileno()
        except (OSError, AttributeError, ValueError):
            self._fd = -1  # pyserial's own reading has to do
            with contextlib.suppress(Exception):
                port._socket.settimeout(_WRITE_S)  # of rfc2217://
            if port.timeout != _SLICE_S:
                port.timeout = _SLICE_S
        self._waiting = [self._fd]

    def close(self) -> None:
        """Let go of the port; safe to call twice."""
        self._let_go()
        if self._claim is not None:
            self._claim.release()

    def _let_go(self) -> None:
        self._set_aside()
        while self._aside:
            with contextlib.suppress(Exception):
                self._aside.pop().close()

    def write(self, data: bytes) -> None:
        """Send bytes; raises LinkError."""
        if self._port is None:
            raise LinkError(f"{self._what}: gone")
        try:
            if self._fd >= 0:
                # What the kernel's buffer, of forty cycles' worth, does not take is not waited for.
                if os.write(self._fd, data) < len(data):
                    raise BlockingIOError("the other end takes nothing")
            else:
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
                return self._read_in_slices(deadline_s)
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

    def _read_in_slices(self, deadline_s: float) -> bytes:
        port = self._port
        data = b""
        while not (data or port.in_waiting):
            if perf_counter() >= deadline_s:
                return b""
            data = port.read(1)
        waiting = min(port.in_waiting, _CHUNK)
        return data + port.read(waiting) if waiting else data

    def _set_aside(self) -> None:
        if self._port is not None:
            self._aside.append(self._port)
        self._port, self._fd = None, -1

    def _lost(self, error: Exception) -> None:
        # Closing waits: for a line to drain, over TCP 0.3 s, rfc2217:// for a thread. In this cycle
        # other ports have not had their zero force yet.
        self._set_aside()
        raise LinkError(f"{self._what}: lost: {error}") from None
