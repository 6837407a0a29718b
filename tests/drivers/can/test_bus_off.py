"""Bus-off of the host's own controller is a fault of its own name, on whatever interface."""

from __future__ import annotations

import socket
import struct
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from levid.config.buses import CanBus
from levid.config.rig import RigConfig
from levid.config.shipped import shipped
from levid.drivers.base import Context, Devices, LinkError, StaleError
from levid.drivers.can.bus_link import CanLink
from levid.drivers.open_backends import open_devices
from levid.sim.electronics import can_emulator
from levid.sim.electronics.emulated_rig import Electronics
from levid.wire.can.can_bus import _KernelBus
from levid.wire.can.kernel_frame import BUS_OFF_ID, pack_frame
from levid.wire.can.local_bus import LocalBus, LocalFrames

RATE_HZ = 50.0
WAIT_S = 30.0


def heard_in(link: CanLink, seconds: float = WAIT_S) -> bool:
    """Receive until a frame came that somebody listens to; False where none does."""
    heard: list[bytes] = []
    link.listen(0x123, lambda _, data: heard.append(data))
    until_s = time.perf_counter() + seconds
    while not heard and time.perf_counter() < until_s:
        link.receive(until_s)
    return bool(heard)


@pytest.fixture
def kernel() -> Iterator[tuple[CanLink, Callable[[bytes], object]]]:
    """A link whose frames are laid out as by the kernel, and what sends it some: UDP for CAN."""
    ends = [socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(2)]
    for end in ends:
        end.bind(("127.0.0.1", 0))
    ends[1].connect(ends[0].getsockname())
    config = CanBus(interface="socketcan", channel="can0")
    link = CanLink("main", config, _KernelBus(None, ends[0]))
    yield link, ends[1].send
    for end in ends:
        end.close()


@pytest.mark.parametrize("can_id", [0x2000_0040, 0x2000_0044, 0x2000_01FF])
def test_error_frame_of_the_kernel_names_bus_off(kernel, can_id: int) -> None:
    link, send = kernel
    send(pack_frame(0x123, b"before"))
    send(pack_frame(can_id, bytes(8)))
    assert heard_in(link)
    words = r"can main \(socketcan can0\): lost: the controller is bus-off"
    with pytest.raises(LinkError, match=words):
        link.receive(time.perf_counter() + WAIT_S)
    with pytest.raises(LinkError, match="not open"):  # until `open`
        link.send(0x123, b"")


@pytest.mark.parametrize("can_id", [0x2000_0004, 0x2000_0080, 0x40, 0x8000_0040, 0x4000_0040])
def test_other_error_frames_and_ids_are_no_bus_off(kernel, can_id: int) -> None:
    """Errors that a controller recovers from by itself, its restart, and frames of such an ID."""
    link, send = kernel
    send(pack_frame(can_id, bytes(8)))
    send(pack_frame(0x123, b"after"))
    assert heard_in(link)


def test_bus_off_id_is_that_of_linux() -> None:
    """linux/can.h: CAN_ERR_FLAG; linux/can/error.h: CAN_ERR_BUSOFF."""
    assert BUS_OFF_ID == 0x2000_0000 | 0x0000_0040
    assert pack_frame(BUS_OFF_ID, bytes(8)) == struct.pack("=IB3x8x", 0x2000_0040, 8)


def test_tools_of_python_can_see_bus_off_as_an_error_frame(tmp_path: Path) -> None:
    here, there = LocalFrames(tmp_path, True), LocalBus(str(tmp_path), fd=True)
    here.receive(1.0)  # takes it in
    here.send(BUS_OFF_ID, bytes(8))
    message = there.recv(WAIT_S)
    assert message is not None
    assert (message.is_error_frame, message.arbitration_id) == (True, 0x40)
    here.send(0x123, b"after")
    message = there.recv(WAIT_S)
    assert message is not None
    assert bytes(message.data) == b"after"
    here.shutdown()
    there.shutdown()


@pytest.mark.usefixtures("host_paced")
@pytest.mark.parametrize("bus", ["can", "canlocal"])
@pytest.mark.parametrize(
    ("line", "error", "words"),
    [
        ("bus-off", LinkError, "lost: the controller is bus-off"),
        ("disconnect", StaleError, "received: nothing"),
        ("drop", StaleError, "received: nothing"),
    ],
)
def test_host_distinguishes_bus_off_from_silence(
    bus: str, line: str, error: type[Exception], words: str, rig_on, patience
) -> None:
    patience.seconds = 2.5 / RATE_HZ
    rig: RigConfig = rig_on(bus, RATE_HZ, shipped("sims/nominal.yaml"))
    with Electronics(rig, Path()) as electronics:
        devices = open_devices(Context(rig, 1 / RATE_HZ, Path()))
        try:
            electronics.injector.command(line)
            with pytest.raises(error, match=words):
                cycles(devices, range(10))
            electronics.injector.clear()
            devices.recover()  # once it is back
            cycles(devices, range(10, 12))
        finally:
            devices.close()


def cycles(devices: Devices, numbers: range) -> None:
    gap_m = np.zeros(9)
    for cycle in numbers:
        for sync in devices.syncs:
            sync(cycle)
        devices.sensors.read(gap_m)


def test_error_frames_are_sent_on_software_interfaces_only(tmp_path: Path, monkeypatch) -> None:
    """It would send the ID that is left without the flags."""
    (tmp_path / "vcan0").mkdir()
    monkeypatch.setattr(can_emulator, "_WITHOUT_DEVICE", tmp_path)
    found = {
        (interface, channel): can_emulator._transmits_errors(
            CanBus(interface=interface, channel=channel)
        )
        for interface, channel in (
            ("socketcan", "vcan0"), ("socketcan", "can0"), ("slcan", "/dev/ttyACM0"),
            ("virtual", "x"), ("levid_local", "/tmp/x"),
        )
    }  # fmt: skip
    assert list(found.values()) == [True, False, False, True, True]


def test_error_frame_goes_over_an_interface_of_python_can(tmp_path: Path) -> None:
    config = CanBus(interface="virtual", channel=tmp_path.name)
    link, other = CanLink("main", config), can_emulator.open_bus(config)
    link.open()
    other.send(BUS_OFF_ID, bytes(8))
    with pytest.raises(LinkError, match="bus-off"):
        link.receive(time.perf_counter() + WAIT_S)
    link.close()
    other.shutdown()
