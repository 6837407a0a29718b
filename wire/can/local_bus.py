"""CAN bus between processes of one host without CAN hardware: frames over Unix sockets.

The interface `levid_local` of python-can; its channel is a folder. Unlike vcan it needs no
privileges, and it is faster than udp_multicast, which returns every frame to its sender and handles
the frames of a real-time loop at ordinary priority. For emulated electronics and tests: there is no
arbitration and no bus error, except lost frames and errors that the electronics emulate.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
import secrets
import select
import socket
import stat
from collections.abc import Iterator
from pathlib import Path
from time import monotonic, time
from typing import Any

import can

from ...config.files.folders import make_folder
from .kernel_frame import (
    ERROR_BUS_OFF,
    FRAME_SIZES,
    OTHER,
    SO_TIMESTAMPNS,
    STAMP_BYTES,
    BusOffError,
    ReceivedFrame,
    kernel_stamp_s,
    pack_frame,
    unpack_frame,
)

_BACKLOG = 16
_RETRY_S = 0.1
"""Interval of connecting to a member whose backlog was full."""
_SUFFIX = ".can"
_MOST_BYTES = max(FRAME_SIZES) + 1  # one more, to detect longer data


class LocalFrames:
    """The bus in `folder`: every member has a connection to every other member.

    A member that does not read loses frames, as a controller with a full queue does. `send` and
    `receive` accept new members first, so that a member that joins late takes part from its first
    frame on, however busy the bus is. `receive` reads the members in turn.
    """

    def __init__(self, folder: Path, fd: bool) -> None:
        """Join the bus; raises OSError, also for a folder that all users may write to."""
        self._fd, self._folder = fd, folder
        self._peers: tuple[socket.socket, ...] = ()
        self._unreached: list[str] = []  # names of members that accept no connection now
        self._retry_s = 0.0
        self._turn = 0
        if folder.exists() and not folder.is_dir():
            raise NotADirectoryError(errno.ENOTDIR, "expected a folder for sockets", str(folder))
        make_folder(folder, 0o700)
        if folder.stat().st_mode & stat.S_IWOTH:
            what = "expected a private folder, found one that all users may write to (chmod o-w)"
            raise PermissionError(errno.EPERM, what, str(folder))
        name = f"{secrets.token_hex(4)}{_SUFFIX}"
        self._path = folder / name
        self._listener = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        try:
            # Of two members that join at once, the second connects to the first.
            with _locked(folder) as short:
                members = sorted(short.glob(f"*{_SUFFIX}"))
                self._listener.bind(str(short / name))
                self._listener.listen(_BACKLOG)
                self._listener.setblocking(False)
                for path in members:
                    self._connect(path)
        except BaseException:
            self.shutdown()
            raise

    def send(self, can_id: int, data: bytes) -> None:
        """Send a frame to all other members."""
        self._meet()
        frame = pack_frame(can_id, data)
        for peer in self._peers:
            try:
                peer.send(frame, socket.MSG_DONTWAIT)
            except BlockingIOError:
                continue
            except OSError:
                self._drop(peer)

    def receive(self, wait_s: float | None) -> ReceivedFrame | None:
        """Return the next frame, None if none arrives within `wait_s` (None: forever).

        Raises BusOffError if another process emulates it.
        """
        self._meet()
        frame = self._next()  # mostly a frame is waiting already
        if frame is not None:
            return frame
        if wait_s is not None and wait_s <= 0.0:
            return None
        ready, _, _ = select.select([self._listener, *self._peers], (), (), wait_s)
        if not ready:
            return None
        self._meet()
        return self._next() or OTHER  # a member joined or left

    def shutdown(self) -> None:
        """Leave the bus; safe to call twice."""
        with contextlib.suppress(OSError):
            self._path.unlink(missing_ok=True)
        for end in (self._listener, *self._peers):
            end.close()
        self._peers = ()

    def _meet(self) -> None:
        """Accept the members that joined, and connect to those that accepted none before."""
        while True:
            try:
                end, _ = self._listener.accept()
            except OSError:
                break
            _enable_timestamps(end)
            self._peers += (end,)
        if self._unreached and monotonic() >= self._retry_s:
            missed, self._unreached = self._unreached, []
            with contextlib.suppress(OSError), _opened(self._folder) as short:
                for name in missed:
                    with contextlib.suppress(OSError):
                        self._connect(short / name)

    def _connect(self, path: Path) -> None:
        end = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        _enable_timestamps(end)
        try:
            # A stopped process accepts no connection: do not wait; it misses the frames until then.
            end.setblocking(False)
            end.connect(str(path))
        except BlockingIOError:
            end.close()
            self._unreached.append(path.name)
            self._retry_s = monotonic() + _RETRY_S
        except OSError as error:
            end.close()
            if error.errno not in (errno.ECONNREFUSED, errno.ENOENT):
                raise
            with contextlib.suppress(FileNotFoundError):
                if stat.S_ISSOCK(path.lstat().st_mode):  # left by a killed process
                    path.unlink()
        else:
            self._peers += (end,)

    def _next(self) -> ReceivedFrame | None:
        """Return a waiting frame; each call begins at the member after the last sender."""
        peers = self._peers
        for k in range(len(peers)):
            turn = (self._turn + k) % len(peers)
            frame = self._from(peers[turn])
            if frame is not None:
                self._turn = turn + 1
                return frame
        return None

    def _from(self, peer: socket.socket) -> ReceivedFrame | None:
        try:
            raw, extra, _, _ = peer.recvmsg(_MOST_BYTES, STAMP_BYTES, socket.MSG_DONTWAIT)
        except BlockingIOError:
            return None
        except OSError:
            raw, extra = b"", []
        if not raw:
            self._drop(peer)
            return None
        stamp_s = kernel_stamp_s(extra)
        frame = unpack_frame(raw, stamp_s) if len(raw) in FRAME_SIZES else None
        if frame is None or (len(frame.data) > 8 and not self._fd):
            return OTHER._replace(stamp_s=stamp_s)
        return frame

    def _drop(self, peer: socket.socket) -> None:
        self._peers = tuple(other for other in self._peers if other is not peer)
        peer.close()


class LocalBus(can.BusABC):
    """The bus as a python-can interface, for its tools: `python -m can.logger -i levid_local`."""

    def __init__(self, channel: str, fd: bool = False, **more: Any) -> None:
        """Join the bus in the folder `channel`; raises CanInitializationError."""
        super().__init__(channel=channel, **more)
        self.channel_info = f"levid_local {channel}"
        try:
            self.frames = LocalFrames(Path(channel), fd)
        except OSError as error:
            raise can.CanInitializationError(str(error)) from error

    def send(self, msg: can.Message, timeout: float | None = None) -> None:  # noqa: ARG002
        """Send a data frame with an 11-bit ID."""
        if msg.is_extended_id or msg.is_remote_frame or msg.is_error_frame:
            raise can.CanOperationError("expected a data frame with an 11-bit ID")
        self.frames.send(msg.arbitration_id, bytes(msg.data))

    def shutdown(self) -> None:
        """Leave the bus."""
        super().shutdown()
        self.frames.shutdown()

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        try:
            frame = self.frames.receive(timeout)
        except BusOffError:
            return can.Message(
                timestamp=time(), arbitration_id=ERROR_BUS_OFF, is_error_frame=True
            ), False
        if frame is None or frame.can_id < 0:
            return None, False
        fd = len(frame.data) > 8
        return can.Message(
            timestamp=frame.stamp_s or time(),
            arbitration_id=frame.can_id,
            is_extended_id=False,
            data=frame.data,
            is_fd=fd,
            bitrate_switch=fd,
        ), False


def _enable_timestamps(end: socket.socket) -> None:
    """Enable kernel timestamps, as on a CAN interface."""
    with contextlib.suppress(OSError):  # without it the time of reading counts
        end.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 1)


@contextlib.contextmanager
def _opened(folder: Path) -> Iterator[Path]:
    """Yield a short path of the folder, because a socket's path has 107 characters."""
    handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        yield Path(f"/proc/self/fd/{handle}")
    finally:
        os.close(handle)


@contextlib.contextmanager
def _locked(folder: Path) -> Iterator[Path]:
    """Lock the folder; yield a short path of it."""
    with _opened(folder) as short:
        fcntl.flock(int(short.name), fcntl.LOCK_EX)
        yield short
