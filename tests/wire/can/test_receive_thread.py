"""Interfaces that wait as they like are waited for by a thread, never by the loop."""

from __future__ import annotations

import os
import queue
import sys
import threading
import time
import tty
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType, SimpleNamespace

import pytest
from waiting import wait_until

from levid.config.buses import CanBus
from levid.drivers.base import LinkError
from levid.drivers.can.bus_link import CanLink
from levid.wire.can.can_bus import open_bus
from levid.wire.can.kernel_frame import BusOffError, ReceivedFrame
from levid.wire.can.receive_thread import QUEUE_FRAMES, OverrunError, ReceiveThread

LONG_S = 10.0
"""Nothing here takes as long, on any machine."""


class Source:
    """A bus that brings what a test puts there."""

    def __init__(self) -> None:
        self.coming: queue.Queue[ReceivedFrame | Exception] = queue.Queue()
        self.sent: list[tuple[int, bytes]] = []
        self.readers: set[int] = set()
        self.taken = self.handled = 0  # frames that the reader took, and has done with
        self.closed = False

    def send(self, can_id: int, data: bytes) -> None:
        self.sent.append((can_id, data))

    def receive(self, wait_s: float) -> ReceivedFrame | None:
        self.readers.add(threading.get_native_id())
        self.handled = self.taken
        try:
            came = self.coming.get(timeout=wait_s)
        except queue.Empty:
            return None
        self.taken += 1
        if isinstance(came, Exception):
            raise came
        return came

    def shutdown(self) -> None:
        self.closed = True


@pytest.fixture
def source() -> Source:
    return Source()


@pytest.fixture
def ahead(source: Source) -> Iterator[ReceiveThread]:
    bus = ReceiveThread(source)
    yield bus
    bus.shutdown()
    assert source.closed
    assert source.readers.isdisjoint(thread.native_id for thread in threading.enumerate())


def test_frames_keep_their_order_and_timestamp(source, ahead) -> None:
    before_s = time.time()
    for k in range(3):
        source.coming.put(ReceivedFrame(k, b"", 7.0 * k))
    frames = [ahead.receive(LONG_S) for _ in range(3)]
    assert [frame.can_id for frame in frames] == [0, 1, 2]
    assert [frame.stamp_s for frame in frames[1:]] == [7.0, 14.0]
    assert before_s <= frames[0].stamp_s <= time.time()
    assert ahead.receive(0.0) is None
    assert ahead.receive(1e-4) is None


def test_error_of_the_interface_follows_earlier_frames(source, ahead) -> None:
    frame = ReceivedFrame(1, b"", 1.0)
    for came in (frame, OSError("unplugged"), frame, BusOffError()):
        source.coming.put(came)
    assert ahead.receive(LONG_S) == frame
    with pytest.raises(OSError, match="unplugged"):
        ahead.receive(LONG_S)
    assert ahead.receive(LONG_S) == frame
    with pytest.raises(BusOffError):
        ahead.receive(LONG_S)


def test_frames_beyond_the_queue_are_counted_and_reported(source, ahead) -> None:
    for k in range(QUEUE_FRAMES + 5):
        source.coming.put(ReceivedFrame(k & 0x7FF, b"", 1.0))
    wait_until(lambda: source.handled == QUEUE_FRAMES + 5)
    with pytest.raises(OverrunError, match=f"5 frames lost: .* {QUEUE_FRAMES} frames was full"):
        ahead.receive(0.0)
    assert all(ahead.receive(0.0) is not None for _ in range(QUEUE_FRAMES))
    assert ahead.receive(0.0) is None


@pytest.mark.parametrize(
    ("error", "words"), [(BusOffError(), "bus-off"), (OSError("gone"), "receiving failed: gone")]
)
def test_link_reports_the_error_of_its_thread(source, ahead, error, words) -> None:
    link = CanLink("main", CanBus(interface="virtual", channel="read ahead"), ahead)
    source.coming.put(error)
    with pytest.raises(LinkError, match=words):
        link.receive(time.perf_counter() + LONG_S)


def test_thread_takes_the_scheduling_policy_of_its_reader(source, ahead) -> None:
    """The loop gets its priority after the buses have been opened."""
    before = os.sched_getscheduler(0)
    os.sched_setscheduler(0, os.SCHED_BATCH, os.sched_param(0))
    try:
        ahead.receive(0.0)
        (reader,) = source.readers
        wait_until(lambda: os.sched_getscheduler(reader) == os.SCHED_BATCH)
    finally:
        os.sched_setscheduler(0, before, os.sched_param(0))


def test_shutdown_does_not_wait_for_a_bus_that_hangs() -> None:
    """gs_usb waits for good where what is left of a wait is below half a millisecond."""
    source, let_go, done = Source(), threading.Event(), []
    source.receive = lambda _: done.append(let_go.wait(LONG_S))  # type: ignore[method-assign,assignment]
    ahead = ReceiveThread(source, join_s=0.05)
    assert ahead.receive(0.0) is None
    ahead.shutdown()
    assert source.closed
    assert not done  # it still hangs
    let_go.set()


class Device:
    """A gs_usb adapter as its library has it: a time of 0 ms is one without end."""

    device_capability = SimpleNamespace(fclk_can=48_000_000)

    def __init__(self) -> None:
        self.coming: queue.Queue[SimpleNamespace | None] = queue.Queue()
        self.sent: list[SimpleNamespace] = []
        self.readers: set[str] = set()

    def set_timing(self, **_: int) -> None:
        return

    set_bitrate = start = stop = lambda *_: None

    def send(self, frame: SimpleNamespace) -> None:
        self.sent.append(frame)

    def read(self, frame: SimpleNamespace, timeout_ms: int) -> bool:
        self.readers.add(threading.current_thread().name)
        try:
            came = self.coming.get(timeout=1e-3 * timeout_ms if timeout_ms else None)
        except queue.Empty:
            return False
        if came is None:
            return False
        frame.__dict__.update(came.__dict__)
        return True


@pytest.fixture
def device(monkeypatch: pytest.MonkeyPatch) -> Device:
    """python-can's own gs_usb, on stand-ins for the libraries that it imports."""
    device = Device()
    flags = {"CAN_EFF_FLAG": 1 << 31, "CAN_RTR_FLAG": 1 << 30, "CAN_ERR_FLAG": 1 << 29}
    stand_ins: dict[str, dict[str, object]] = {
        "usb": {"core": SimpleNamespace(USBError=OSError)},
        "gs_usb": {},
        "gs_usb.constants": {**flags, "CAN_MAX_DLC": 8},
        "gs_usb.gs_usb": {"GsUsb": SimpleNamespace(scan=lambda: [device])},
        "gs_usb.gs_usb_frame": {"GsUsbFrame": SimpleNamespace, "GS_USB_NONE_ECHO_ID": -1},
    }
    for name, contents in stand_ins.items():
        module = ModuleType(name)
        module.__dict__.update(contents)
        monkeypatch.setitem(sys.modules, name, module)
    monkeypatch.delitem(sys.modules, "can.interfaces.gs_usb", raising=False)
    yield device
    sys.modules.pop("can.interfaces.gs_usb", None)


def heard(can_id: int, data: bytes, echo_id: int = -1) -> SimpleNamespace:
    return SimpleNamespace(
        timestamp=0.0,
        arbitration_id=can_id,
        is_extended_id=False,
        is_remote_frame=False,
        is_error_frame=False,
        can_dlc=len(data),
        data=list(data) + [0] * (8 - len(data)),
        echo_id=echo_id,
    )


def test_gs_usb_is_not_waited_for(device: Device) -> None:
    bus = open_bus(CanBus(interface="gs_usb", channel=0))
    try:
        # A wait of 0.3 ms is one without end for it; none at all is one of a millisecond.
        assert bus.receive(0.0) is None
        assert bus.receive(3e-4) is None
        bus.send(0x10, b"\x12\x00\x2a")
        assert (device.sent[0].can_id, device.sent[0].can_dlc) == (0x10, 3)
        device.coming.put(heard(0x10, b"\x12\x00\x2a", echo_id=0))
        device.coming.put(heard(0x28, b"12345678"))
        echo, answer = bus.receive(LONG_S), bus.receive(LONG_S)
        assert echo.can_id < 0  # what was sent is none that came
        assert answer[:2] == (0x28, b"12345678")
        assert answer.stamp_s > time.time() - LONG_S
        assert device.readers == {"levid-can-reader"}
    finally:
        bus.shutdown()


class Slcan:
    """The adapter's end of a pseudo terminal: notes commands, answers Sync with readings."""

    def __init__(self, path: Path) -> None:
        self._end, self._slave = os.openpty()
        tty.setraw(self._slave)
        path.symlink_to(os.ttyname(self._slave))
        self.commands: list[str] = []
        threading.Thread(target=self._run, daemon=True).start()

    def say(self, text: str) -> None:
        os.write(self._end, text.encode())

    def close(self) -> None:
        os.close(self._slave)

    def _run(self) -> None:
        rest = b""
        while True:
            try:
                rest += os.read(self._end, 4096)
            except OSError:
                os.close(self._end)
                return
            *commands, rest = rest.split(b"\r")
            for command in commands:
                self.commands.append(command.decode())
                self.say("z\r" if command[:1] in b"tb" else "\r")
                if command.startswith(b"t010"):
                    self.say("t02883132333435363738\rT000000281AA\r")


@pytest.fixture
def slcan(tmp_path: Path) -> Iterator[Slcan]:
    adapter = Slcan(tmp_path / "tty")
    yield adapter
    adapter.close()


def test_slcan_on_a_line(slcan: Slcan, tmp_path: Path) -> None:
    options = {"sleep_after_open": 0.0}
    bus = open_bus(CanBus(interface="slcan", channel=str(tmp_path / "tty"), options=options))
    try:
        assert isinstance(bus, ReceiveThread)
        bus.send(0x10, b"\x12\x00\x2a")
        frame = bus.receive(LONG_S)
        assert frame[:2] == (0x28, b"12345678")
        assert abs(time.time() - frame.stamp_s) < LONG_S
        assert bus.receive(LONG_S).can_id < 0  # one of 29 bits is none of ours
        assert bus.receive(0.0) is None
        assert [c for c in slcan.commands if c not in ("", "C", "O")] == ["S8", "t010312002A"]
        # Half a frame is nothing yet, and what is none of slcan ends nothing.
        slcan.say("t0281")
        assert bus.receive(0.01) is None
        slcan.say("FF\r")
        assert bus.receive(LONG_S)[:2] == (0x28, b"\xff")
    finally:
        bus.shutdown()


def test_slcan_is_told_the_data_rate(slcan: Slcan, tmp_path: Path) -> None:
    """python-can reads it out of a timing alone, which nobody can write into YAML."""
    config = CanBus(
        interface="slcan",
        channel=str(tmp_path / "tty"),
        bitrate=500_000,
        data_bitrate=2_000_000,
        options={"sleep_after_open": 0.0},
    )
    bus = open_bus(config)
    try:
        bus.send(0x24, bytes(range(20)))
        wait_until(lambda: any(command.startswith("b") for command in slcan.commands))
        assert slcan.commands[-1] == f"b024B{bytes(range(20)).hex().upper()}"
        assert {"S6", "Y2"} <= set(slcan.commands)
    finally:
        bus.shutdown()
