"""What somebody else in the network sends on a group of udp_multicast stops no flight."""

from __future__ import annotations

import socket
import time
from collections.abc import Iterator

import can
import msgpack
import pytest

from levid.config.buses import CanBus
from levid.drivers.base import LinkError
from levid.drivers.can.bus_link import CanLink
from levid.wire.can.can_bus import open_bus

GROUP, WAIT_S = "239.74.163.78", 30.0
GOOD = {
    "timestamp": 0.0, "arbitration_id": 0x123, "is_extended_id": False, "is_remote_frame": False,
    "is_error_frame": False, "channel": None, "dlc": 1, "data": b"x", "is_fd": False,
    "bitrate_switch": False, "error_state_indicator": False,
}  # fmt: skip
NO_FRAMES = {
    "nothing": b"",
    "noise": bytes(range(200, 256)),
    "text": b"M-SEARCH * HTTP/1.1\r\n\r\n",
    "a number": msgpack.packb(7),
    "cut off": msgpack.packb(GOOD)[:-3],
    "another key": msgpack.packb({**GOOD, "from": "me"}),
    "too long": msgpack.packb({**GOOD, "dlc": 9, "data": bytes(9)}),
    "no such ID": msgpack.packb({**GOOD, "arbitration_id": 0x800}),
    "an ID that is text": msgpack.packb({**GOOD, "arbitration_id": "x", "is_error_frame": True}),
    "an ID that is no whole one": msgpack.packb(
        {**GOOD, "arbitration_id": 1.5, "is_error_frame": True}
    ),
    "data that are none": msgpack.packb({**GOOD, "data": ["x"]}),
    "more than a frame": bytes(9000),
}


@pytest.fixture
def group() -> Iterator[tuple[CanLink, socket.socket, tuple[str, int]]]:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("", 0))
        port = int(probe.getsockname()[1])
    link = CanLink("main", CanBus(interface="udp_multicast", channel=GROUP, options={"port": port}))
    link.open()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:
        yield link, stranger, (GROUP, port)
    link.close()


@pytest.mark.parametrize("what", NO_FRAMES)
def test_datagram_that_is_no_frame_is_nobodys(group, what: str) -> None:
    link, stranger, place = group
    heard: list[bytes] = []
    link.listen(0x123, lambda _, data: heard.append(data))
    for datagram in (NO_FRAMES[what], msgpack.packb(GOOD)):
        stranger.sendto(datagram, place)
    until_s = time.perf_counter() + WAIT_S
    while not heard and time.perf_counter() < until_s:
        link.receive(until_s)
    assert heard == [b"x"]


def test_interface_that_is_gone_is_lost_all_the_same(group) -> None:
    link, *_ = group
    link._bus._bus._multicast._socket.close()
    with pytest.raises(LinkError, match="receiving failed"):
        link.receive(time.perf_counter() + WAIT_S)


def test_other_interfaces_are_lost_by_any_error(monkeypatch: pytest.MonkeyPatch) -> None:
    """On a wire nobody sends what is no frame: it is the adapter that fails."""
    bus = open_bus(CanBus(interface="virtual", channel="strangers"))

    def fails(_: float) -> None:
        raise can.CanOperationError("adapter")

    monkeypatch.setattr(bus._bus, "recv", fails)
    with pytest.raises(can.CanOperationError):
        bus.receive(0.0)
    bus.shutdown()
