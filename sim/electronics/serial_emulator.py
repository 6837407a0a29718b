"""Emulate electronics on a serial port: a pseudo terminal or a TCP port."""

from __future__ import annotations

import contextlib
import os
import select
import socket
import threading
import time
import tty
from collections.abc import Mapping
from pathlib import Path
from typing import Protocol
from urllib.parse import urlparse

import numpy as np

from ...config.base import ConfigError
from ...config.buses import RoleOptions
from ...config.files.atomic_write import replace_link
from ...config.files.folders import make_folder
from ...config.rig import RigConfig
from ...wire.frame_rejection_reasons import Rejected
from ...wire.serial.frame_splitter import FrameStream
from ...wire.serial.serial_frames import FrameContents, Kind, SerialFrames
from .emulated_devices import Core
from .faults import Injector, Outgoing

_CHUNK = 4096


class SerialElectronics:
    """Answers on one port until `stop`; `start` opens it.

    `port` in RIG.yaml is a path, created as a link to a pseudo terminal, or socket://HOST:PORT,
    where the electronics listen. `line` is used instead of that port if there is one.
    """

    def __init__(
        self,
        name: str,
        rig: RigConfig,
        folder: Path,  # noqa: ARG002 - every emulator has it; here no path is relative to it
        roles: Mapping[str, RoleOptions],
        core: Core,
        injector: Injector,
        line: Line | None = None,
    ) -> None:
        port, contents = rig.serial[name].port, FrameContents.of(rig, roles)
        self._contents, self._core, self.injector = contents, core, injector
        kind = _TcpLine if "://" in port else _Pty
        self._line: Line = line or kind(name, port)
        self._frames = SerialFrames(contents)
        self._stream = FrameStream(self._frames.longest)
        self._outgoing = Outgoing(injector)
        self._coil_n = np.zeros(contents.coils)
        self._motion = np.zeros((2, 3))
        self._sequence = -1
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self.serve, name=f"levid-{name}", daemon=True)

    def start(self) -> None:
        """Open the port and answer from now on."""
        self._line.open()
        self._thread.start()

    def stop(self) -> None:
        """Stop answering and close the port."""
        self._stopping.set()
        if self._thread.is_alive():
            self._thread.join()
        self._line.close()

    def serve(self) -> None:
        """Answer in the calling thread until `stop`."""
        patience_s = min(1.5 * self._core.period_s, 0.1)
        while not self._stopping.is_set():
            silent_s = time.monotonic() + patience_s
            if "disconnect" in self.injector.wire:
                self._line.close()
                self._stopping.wait(patience_s)
                self._core.tick(min(silent_s, time.monotonic()))
                continue
            self._line.open()
            data = self._line.read(patience_s)
            read_s = time.monotonic()
            if not data:
                self._core.tick(min(silent_s, read_s))
                continue
            if self.injector.receives:
                for block in self._stream.feed(data):
                    self._answer(block)
            if len(data) < _CHUNK:  # nothing more was waiting
                self._core.tick(read_s)

    def _answer(self, block: bytes) -> None:
        frames, core = self._frames, self._core
        header = frames.accept(block)
        if isinstance(header, Rejected):
            return
        if header.kind is Kind.CYCLE:
            with core.lock:
                self._store_setpoints()
                core.begin(header.sequence)
                if self._contents.coils:  # also if another bus began the cycle
                    core.apply_setpoints(renews=header.sequence != self._sequence)
                self._sequence = header.sequence
                readings = frames.readings(
                    header.sequence,
                    (core.reported_state, core.force_n),
                    (core.sensor_state, core.gap_m),
                    (core.drive_state, core.drive_error, core.axes),
                )
            out = [data for _, data in self._outgoing.through([(0, readings)])]
        elif header.kind is Kind.REQUEST:
            index, value = core.request(*frames.request_received())
            out = [frames.answer(header.sequence, index, value)]
            if self.injector.wire & {"drop", "bus-off"}:
                out = []
        else:
            return
        for data in out:
            self._line.write(data)

    def _store_setpoints(self) -> None:
        if "drop-setpoints" in self.injector.wire:
            return
        if self._contents.coils:
            self._frames.setpoints(self._coil_n)
            self._core.setpoints(self._coil_n)
        if self._contents.drives:
            self._frames.drive_setpoints(self._motion[0], self._motion[1])
            self._core.drive_setpoints([self._motion])


class Line(Protocol):
    """Bytes in and out; `open` and `close` may be repeated."""

    def open(self) -> None:
        """Open the line."""

    def close(self) -> None:
        """Close the line."""

    def read(self, timeout_s: float) -> bytes:
        """Return what came, empty if nothing came in time."""

    def write(self, data: bytes) -> None:
        """Send bytes, which are lost if there is no other end."""


class _Pty:
    def __init__(self, name: str, port: str) -> None:
        self._path = Path(port)
        self._master = -1
        if self._path.exists() and not self._path.is_symlink():
            raise ConfigError(
                f"serial.{name}.port: expected a path for a new pseudo terminal, found {port}"
            )

    def open(self) -> None:
        if self._master >= 0:
            return
        self._master, slave = os.openpty()
        tty.setraw(slave)
        os.set_blocking(self._master, False)
        make_folder(self._path.parent)
        replace_link(self._path, os.ttyname(slave))
        os.close(slave)

    def close(self) -> None:
        if self._master < 0:
            return
        self._path.unlink(missing_ok=True)
        os.close(self._master)
        self._master = -1

    def read(self, timeout_s: float) -> bytes:
        ready, _, _ = select.select([self._master], [], [], timeout_s)
        if not ready:
            return b""
        try:
            return os.read(self._master, _CHUNK)
        except BlockingIOError:
            return b""
        except OSError:  # the port is not open: select does not report when it is opened
            threading.Event().wait(timeout_s)
            return b""

    def write(self, data: bytes) -> None:
        with contextlib.suppress(OSError):  # the port is not open: bytes are lost
            os.write(self._master, data)


class _TcpLine:
    def __init__(self, name: str, url: str) -> None:
        parts = urlparse(url)
        if parts.scheme != "socket" or parts.hostname is None or parts.port is None:
            raise ConfigError(
                f"serial.{name}.port: expected a path or socket://HOST:PORT for the electronics, "
                f"found {url}"
            )
        self._address = (parts.hostname, parts.port)
        self._listener: socket.socket | None = None
        self._client: socket.socket | None = None

    def open(self) -> None:
        if self._listener is None:
            self._listener = socket.create_server(self._address)

    def close(self) -> None:
        for end in (self._client, self._listener):
            if end is not None:
                end.close()
        self._client = self._listener = None

    def read(self, timeout_s: float) -> bytes:
        assert self._listener is not None
        # A new client replaces one that was lost without closing.
        ends = [self._listener] + ([self._client] if self._client is not None else [])
        ready, _, _ = select.select(ends, [], [], timeout_s)
        if self._listener in ready:
            if self._client is not None:
                self._client.close()
            self._client, _ = self._listener.accept()
            self._client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            return b""
        if self._client is None or not ready:
            return b""
        try:
            data = self._client.recv(_CHUNK)
        except OSError:
            data = b""
        if not data:
            self._client.close()
            self._client = None
        return data

    def write(self, data: bytes) -> None:
        if self._client is not None:
            with contextlib.suppress(OSError):
                self._client.sendall(data)
