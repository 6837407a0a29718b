"""Checks on a vcan what the host takes from the kernel beside data: stamps, and a bus-off."""

from __future__ import annotations

import socket
import sys
import time

from levid.config.buses import CanBus
from levid.drivers.base import LinkError
from levid.drivers.can.bus_link import CanLink
from levid.sim.electronics.can_emulator import _transmits_errors
from levid.wire.can.can_bus import open_bus
from levid.wire.can.kernel_frame import BUS_OFF_ID, ERROR
from levid.wire.can.timestamps import SO_TIMESTAMPING, KernelStamps

WAIT_S = 60.0
config = CanBus(interface="socketcan", channel=sys.argv[1], data_bitrate=5_000_000)
other, link, came = open_bus(config), CanLink("main", config), []
link.listen(0x123, lambda _, data: came.append((data, link.received_s)))
link.open()
raw = link._bus._socket
assert raw.getsockopt(socket.SOL_SOCKET, SO_TIMESTAMPING), "the kernel was not asked for its stamps"


def frame(data: bytes) -> float:
    """Send one, look at it half a second later, and return when it is said to have come."""
    other.send(0x123, data)
    time.sleep(0.5)
    assert link.receive(time.perf_counter() + WAIT_S)
    assert came[-1][0] == data
    return came[-1][1]


frame(b"first")  # the kernel begins to stamp a little after somebody asks for that
for data in (b"classic", bytes(20)):
    sent_s = time.perf_counter()
    received_s = frame(data)
    # By when it was looked at it would be half a second; a guest that stalls does so for less.
    assert -0.01 < received_s - sent_s < 0.25, received_s - sent_s
other.send(0x123, b"beside")
_, beside, _, _ = raw.recvmsg(72, KernelStamps.room)
assert SO_TIMESTAMPING in [kind for _, kind, _ in beside], beside
other.send(ERROR | 0x04, bytes(8))  # a controller that is warned is not off
assert link.receive(time.perf_counter() + WAIT_S)
assert _transmits_errors(config)
other.send(BUS_OFF_ID, bytes(8))
ended = ""
try:
    link.receive(time.perf_counter() + WAIT_S)
except LinkError as error:
    ended = str(error)
assert "the controller is bus-off" in ended, ended or "taken for a frame"
print(f"{sys.argv[1]}: frames have the kernel's stamp, and a bus-off is told as such")
