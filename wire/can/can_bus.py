"""Send and receive CAN frames on any bus of python-can: ID and bytes, with a timestamp on receipt.

Interfaces go through python-can's Message, and through a reading thread if their timeouts are
inaccurate. socketcan, the interface of the rig, uses the kernel's frame layout instead: a Message
with its checks and copies takes longer than the frame on the wire. python-can opens, configures and
closes every bus.
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
from .kernel_frame import (
    ERROR,
    ERROR_BUS_OFF,
    FRAME_SIZES,
    OTHER,
    BusOffError,
    ReceivedFrame,
    pack_frame,
    unpack_frame,
)
from .python_can_interface_table import adapter_of, arguments
from .receive_thread import ReceiveThread
from .timestamps import OLDEST_S, HardwareClock, KernelStamps

_LONGEST = max(FRAME_SIZES)
_FULL_S = 0.001
_SENDS_BY = {"slcan", "udp_multicast"}
"""Interfaces whose send timeout covers queueing only. Others ignore it, or wait until the frame has
been sent."""
_STAMPED_HERE = {"levid_local", "slcan", "socketcan", "udp_multicast", "virtual"}
_SEND_S = 0.005
_NETWORKS = {"udp_multicast"}
"""Interfaces on which frames may be lost, and other programs may send invalid data, for which
python-can raises the same error as for a lost interface."""


class Ages:
    """Computes the age of received frames from their timestamps.

    Some interfaces use this host's time of day; the others use a clock of their hardware.
    """

    def __init__(self, interface: str) -> None:
        self._hardware = None if interface in _STAMPED_HERE else HardwareClock()

    def of(self, stamp_s: float) -> float | None:
        """Return the age in s of the frame just read, None if its timestamp is unusable."""
        if stamp_s <= 0.0:
            return None
        if self._hardware is not None:
            return self._hardware.age_s(stamp_s, perf_counter())
        age_s = time() - stamp_s
        return age_s if 0.0 <= age_s < OLDEST_S else None


class FrameBus(Protocol):
    """An open bus."""

    def send(self, can_id: int, data: bytes) -> None:
        """Send a frame, CAN FD with bit rate switch above 8 bytes; raises the error of the bus.

        An ID with ERROR sends an error frame, on software interfaces only.
        """

    def receive(self, wait_s: float) -> ReceivedFrame | None:
        """Return the next frame, None if none arrives within `wait_s`; raises BusOffError."""

    def shutdown(self) -> None:
        """Close the bus."""


def open_bus(config: CanBus) -> FrameBus:
    """Open a bus; raises the error of the interface."""
    if config.interface == "levid_local":
        from .local_bus import LocalFrames

        return LocalFrames(Path(str(config.channel)), config.fd)
    import can

    bus: Any = can.Bus(
        interface=config.interface,
        channel=config.channel,
        bitrate=config.bitrate,
        receive_own_messages=False,
        ignore_config=True,  # RIG.yaml says all, not the user's can.conf or CAN_CONFIG
        **arguments(config),
    )
    if config.interface == "socketcan" and isinstance(getattr(bus, "socket", None), socket.socket):
        return _KernelBus(bus, bus.socket)
    timeout_s = _SEND_S if config.interface in _SENDS_BY else None
    messages = _MessageBus(bus, can.Message, timeout_s, config.interface in _NETWORKS)
    return messages if adapter_of(config.interface).punctual else ReceiveThread(messages)


class _MessageBus:
    """An interface that is used through python-can's Message."""

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
            # Networks lose frames silently anyway: treat this one the same.
            if not self._network:
                raise

    def receive(self, wait_s: float) -> ReceivedFrame | None:
        try:
            message = self._bus.recv(wait_s)
        except Exception as error:
            cause = error.__cause__  # set if the data could not be unpack_frame
            if self._network and cause is not None and not isinstance(cause, OSError):
                return OTHER
            raise
        if message is None:
            return None
        if message.is_error_frame:
            if int(message.arbitration_id) & ERROR_BUS_OFF:
                raise BusOffError
            return OTHER._replace(stamp_s=message.timestamp)
        # Some interfaces return sent frames despite receive_own_messages=False.
        if message.is_extended_id or message.is_remote_frame or not message.is_rx:
            return OTHER._replace(stamp_s=message.timestamp)
        return ReceivedFrame(message.arbitration_id, bytes(message.data), message.timestamp)

    def shutdown(self) -> None:
        with contextlib.suppress(Exception):
            self._bus.shutdown()


class _KernelBus:
    """socketcan, on the socket opened by python-can."""

    def __init__(self, bus: Any, raw: socket.socket) -> None:
        self._bus, self._socket = bus, raw
        self._waiting, self._stamps = [raw], KernelStamps(raw)

    def send(self, can_id: int, data: bytes) -> None:
        frame = pack_frame(can_id, data)
        try:
            self._socket.send(frame, socket.MSG_DONTWAIT)
        except OSError as error:  # full, and it may stay so: without an acknowledge, for example
            if error.errno == errno.ENOBUFS:  # queue of the interface: select does not report room
                sleep(_FULL_S)
            elif error.errno == errno.EAGAIN:
                select.select((), self._waiting, (), _FULL_S)
            else:
                raise
            self._socket.send(frame, socket.MSG_DONTWAIT)

    def receive(self, wait_s: float) -> ReceivedFrame | None:
        try:  # mostly a frame is waiting already
            raw, extra, _, _ = self._socket.recvmsg(
                _LONGEST, KernelStamps.room, socket.MSG_DONTWAIT
            )
        except BlockingIOError:
            if wait_s <= 0.0 or not select.select(self._waiting, (), (), wait_s)[0]:
                return None
            raw, extra, _, _ = self._socket.recvmsg(_LONGEST, KernelStamps.room)
        return unpack_frame(raw, self._stamps.received_s(extra))

    def shutdown(self) -> None:
        with contextlib.suppress(Exception):
            self._bus.shutdown()
