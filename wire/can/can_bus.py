"""A bus of python-can as plain frames: a number and bytes in, a number, bytes and a stamp out.

Any interface goes through python-can's own Message, and where it does not wait by the time it is
given, through a thread that reads it. For socketcan, the interface of the rig, frames are read and
written as the kernel lays them out: a Message, its checks and copies take longer than the frame
takes on the wire. The bus is opened, configured and closed by python-can all the same.
"""

from __future__ import annotations

import contextlib
import errno
import select
import socket
from pathlib import Path
from time import perf_counter, sleep, time
from typing import Any, Protocol

from ...config.buses import CanBus
from .adapters import adapter_of, arguments
from .kernel_frame import (
    ERROR,
    ERROR_BUS_OFF,
    FRAME_SIZES,
    OTHER,
    BusOffError,
    ReceivedFrame,
    packed,
    unpacked,
)
from .read_ahead import ReadAhead
from .timestamps import OLDEST_S, HardwareClock, KernelStamps

_LONGEST = max(FRAME_SIZES)
_FULL_S = 0.001
_SENDS_BY = {"slcan", "udp_multicast"}
"""Interfaces that take a time by which a frame is to be on its way. Others ignore it, or wait for
the frame to have left."""
_STAMPED_HERE = {"levid_local", "slcan", "socketcan", "udp_multicast", "virtual"}
_SEND_S = 0.005
_NETWORKS = {"udp_multicast"}
"""Interfaces on which any frame may be lost, and anybody may send what is none, for which the
library has the same error as for an interface that is gone."""


class Ages:
    """Tells how long ago frames came, by their stamps.

    Interfaces of the kernel stamp with this host's time of day, or bring hardware's to it; others
    stamp by a clock of their own.
    """

    def __init__(self, interface: str) -> None:
        self._hardware = None if interface in _STAMPED_HERE else HardwareClock()

    def of(self, stamp_s: float) -> float | None:
        """Return the age in s of the frame that was just read, None where its stamp tells none."""
        if stamp_s <= 0.0:
            return None
        if self._hardware is not None:
            return self._hardware.age_s(stamp_s, perf_counter())
        age_s = time() - stamp_s
        return age_s if 0.0 <= age_s < OLDEST_S else None


class FrameBus(Protocol):
    """An open bus."""

    def send(self, can_id: int, data: bytes) -> None:
        """Send a frame, CAN FD with bit rate switch beyond 8 bytes; raises what the bus raises.

        An ID with ERROR makes it an error frame, where there is no wire but software.
        """

    def receive(self, wait_s: float) -> ReceivedFrame | None:
        """Return the next frame, None if none comes within `wait_s`; raises BusOffError too."""

    def shutdown(self) -> None:
        """Close the bus."""


def open_bus(config: CanBus) -> FrameBus:
    """Open the bus that a rig names; raises whatever the interface raises."""
    if config.interface == "levid_local":
        from .local_bus import LocalFrames

        return LocalFrames(Path(str(config.channel)), config.fd)
    import can

    bus: Any = can.Bus(
        interface=config.interface,
        channel=config.channel,
        bitrate=config.bitrate,
        receive_own_messages=False,
        **arguments(config),
    )
    if config.interface == "socketcan" and isinstance(getattr(bus, "socket", None), socket.socket):
        return _KernelBus(bus, bus.socket)
    timeout_s = _SEND_S if config.interface in _SENDS_BY else None
    messages = _MessageBus(bus, can.Message, timeout_s, config.interface in _NETWORKS)
    return messages if adapter_of(config.interface).punctual else ReadAhead(messages)


class _MessageBus:
    """Any interface, by its Messages."""

    def __init__(
        self, bus: Any, message: Any, timeout_s: float | None, network: bool = False
    ) -> None:
        self._bus, self._message, self._timeout_s = bus, message, timeout_s
        self._network = network

    def send(self, can_id: int, data: bytes) -> None:
        fd = len(data) > 8
        message = self._message(
            arbitration_id=can_id & ~ERROR,
            is_extended_id=False,
            is_error_frame=bool(can_id & ERROR),
            data=data,
            is_fd=fd,
            bitrate_switch=fd,
        )
        try:
            self._bus.send(message, self._timeout_s)
        except TimeoutError:
            # A network may lose any frame and says nothing: this one is known, and no less lost.
            if not self._network:
                raise

    def receive(self, wait_s: float) -> ReceivedFrame | None:
        try:
            message = self._bus.recv(wait_s)
        except Exception as error:
            cause = error.__cause__  # of what could not be unpacked: something in it
            if self._network and cause is not None and not isinstance(cause, OSError):
                return OTHER
            raise
        if message is None:
            return None
        if message.is_error_frame:
            if int(message.arbitration_id) & ERROR_BUS_OFF:
                raise BusOffError
            return OTHER._replace(stamp_s=message.timestamp)
        # Some hand back what was sent, whatever they are asked for.
        if message.is_extended_id or message.is_remote_frame or not message.is_rx:
            return OTHER._replace(stamp_s=message.timestamp)
        return ReceivedFrame(message.arbitration_id, bytes(message.data), message.timestamp)

    def shutdown(self) -> None:
        with contextlib.suppress(Exception):
            self._bus.shutdown()


class _KernelBus:
    """socketcan, on the socket that python-can opened."""

    def __init__(self, bus: Any, raw: socket.socket) -> None:
        self._bus, self._socket = bus, raw
        self._waiting, self._stamps = [raw], KernelStamps(raw)

    def send(self, can_id: int, data: bytes) -> None:
        frame = packed(can_id, data)
        try:
            self._socket.send(frame, socket.MSG_DONTWAIT)
        except OSError as error:  # the queue is full, and may stay so: nobody acknowledges, say
            if error.errno == errno.ENOBUFS:  # the interface's own: nothing says when there is room
                sleep(_FULL_S)
            elif error.errno == errno.EAGAIN:
                select.select((), self._waiting, (), _FULL_S)
            else:
                raise
            self._socket.send(frame, socket.MSG_DONTWAIT)

    def receive(self, wait_s: float) -> ReceivedFrame | None:
        try:  # mostly it is there already, and need not be waited for
            raw, extra, _, _ = self._socket.recvmsg(
                _LONGEST, KernelStamps.room, socket.MSG_DONTWAIT
            )
        except BlockingIOError:
            if wait_s <= 0.0 or not select.select(self._waiting, (), (), wait_s)[0]:
                return None
            raw, extra, _, _ = self._socket.recvmsg(_LONGEST, KernelStamps.room)
        return unpacked(raw, self._stamps.came_s(extra))

    def shutdown(self) -> None:
        with contextlib.suppress(Exception):
            self._bus.shutdown()
