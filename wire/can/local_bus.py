"""A CAN bus between processes of one host, where the kernel has none: frames over Unix sockets.

An interface of python-can, `levid_local`, whose channel is a folder. It needs no rights, as vcan
does, is nobody else's, and is quicker than udp_multicast, which hands every frame back to who sent
it and lets ordinary priority carry the frames of a real-time loop. For emulated electronics and
tests; nothing is on a wire, nothing arbitrates, and there is no error but a frame that is lost, and
one that electronics play.
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
from time import time
from typing import Any

import can

from .kernel_frame import (
    ERROR_BUS_OFF,
    FRAME_SIZES,
    OTHER,
    SO_TIMESTAMPNS,
    STAMP_BYTES,
    BusOffError,
    ReceivedFrame,
    kernel_stamp_s,
    packed,
    unpacked,
)

_WAITING = 16
_SUFFIX = ".can"
_MOST_BYTES = max(FRAME_SIZES) + 1  # so that what is longer is not taken for a frame


class LocalFrames:
    """Who is on the bus in `folder` holds a connection to everybody else who is.

    A receiver that does not read loses frames, as a controller does whose queue is full. Who joins
    is noticed with the next `receive`.
    """

    def __init__(self, folder: Path, fd: bool) -> None:
        """Join; raises OSError, among others for a folder that everybody may write to."""
        self._fd = fd
        self._peers: tuple[socket.socket, ...] = ()
        if folder.exists() and not folder.is_dir():
            raise NotADirectoryError(errno.ENOTDIR, "expected a folder for sockets", str(folder))
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        if folder.stat().st_mode & stat.S_IWOTH:
            what = "expected a folder that is nobody else's, found one that everybody may write to"
            raise PermissionError(errno.EPERM, what, str(folder))
        name = f"{secrets.token_hex(4)}{_SUFFIX}"
        self._path = folder / name
        self._door = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        try:
            # Of two that join at once one comes second, and connects to the other.
            with _alone_in(folder) as short:
                others = sorted(short.glob(f"*{_SUFFIX}"))
                self._door.bind(str(short / name))
                self._door.listen(_WAITING)
                self._door.setblocking(False)
                for path in others:
                    self._connect(path)
        except BaseException:
            self.shutdown()
            raise

    def send(self, can_id: int, data: bytes) -> None:
        """Send a frame to all others."""
        frame = packed(can_id, data)
        for peer in self._peers:
            try:
                peer.send(frame, socket.MSG_DONTWAIT)
            except BlockingIOError:
                continue
            except OSError:
                self._drop(peer)

    def receive(self, wait_s: float | None) -> ReceivedFrame | None:
        """Return the next frame, None if none comes within `wait_s` (None: forever).

        Raises BusOffError where another process plays that.
        """
        for peer in self._peers:  # mostly it is there already, and need not be waited for
            frame = self._from(peer)
            if frame is not None:
                return frame
        if wait_s is not None and wait_s <= 0.0:
            return None
        ready, _, _ = select.select([self._door, *self._peers], (), (), wait_s)
        if self._door in ready:
            self._accept()
        for peer in ready:
            frame = self._from(peer) if peer is not self._door else None
            if frame is not None:
                return frame
        return OTHER if ready else None  # somebody has come or gone: that is no frame of ours

    def shutdown(self) -> None:
        """Leave the bus; safe to call twice."""
        with contextlib.suppress(OSError):
            self._path.unlink(missing_ok=True)
        for end in (self._door, *self._peers):
            end.close()
        self._peers = ()

    def _connect(self, path: Path) -> None:
        end = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        _stamped(end)
        try:
            # One that is stopped takes nobody in: it is not waited for, and misses the frames.
            end.setblocking(False)
            end.connect(str(path))
        except BlockingIOError:
            end.close()
        except OSError as error:
            end.close()
            if error.errno not in (errno.ECONNREFUSED, errno.ENOENT):
                raise
            with contextlib.suppress(FileNotFoundError):
                if stat.S_ISSOCK(path.lstat().st_mode):  # left over from one that was killed
                    path.unlink()
        else:
            self._peers += (end,)

    def _accept(self) -> None:
        with contextlib.suppress(OSError):
            end, _ = self._door.accept()
            _stamped(end)
            self._peers += (end,)

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
        frame = unpacked(raw, stamp_s) if len(raw) in FRAME_SIZES else None
        if frame is None or (len(frame.data) > 8 and not self._fd):
            return OTHER._replace(stamp_s=stamp_s)
        return frame

    def _drop(self, peer: socket.socket) -> None:
        self._peers = tuple(other for other in self._peers if other is not peer)
        peer.close()


class LocalBus(can.BusABC):
    """The same for python-can, whose tools listen on it: `python -m can.logger -i levid_local`."""

    def __init__(self, channel: str, fd: bool = False, **more: Any) -> None:
        """Join the bus in the folder `channel`; raises what python-can raises."""
        super().__init__(channel=channel, **more)
        self.channel_info = f"levid_local {channel}"
        try:
            self.frames = LocalFrames(Path(channel), fd)
        except OSError as error:
            raise can.CanInitializationError(str(error)) from error

    def send(self, msg: can.Message, timeout: float | None = None) -> None:  # noqa: ARG002
        """Send a data frame of an 11-bit ID."""
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


def _stamped(end: socket.socket) -> None:
    """Have the kernel say when frames came, as it does on a CAN interface."""
    with contextlib.suppress(OSError):  # without it a frame is as old as when it is looked at
        end.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 1)


@contextlib.contextmanager
def _alone_in(folder: Path) -> Iterator[Path]:
    """Yield the folder by a short name, for a socket's has 107 characters; nobody else has it."""
    handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX)
        yield Path(f"/proc/self/fd/{handle}")
    finally:
        os.close(handle)
