"""A CAN reading counts if it came by the deadline, by its stamp, whenever this process looks."""

from __future__ import annotations

import contextlib
import errno
import struct
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import can
import numpy as np
import pytest
from claims import is_for_one_loop

from levid.config.buses import CanBus
from levid.config.rig import load_rig
from levid.config.shipped import shipped
from levid.drivers.base import LinkError
from levid.drivers.bus_lock import BusLock
from levid.drivers.can.amplifiers_and_adc import CanAmplifiers
from levid.drivers.can.bus_link import CanLink
from levid.drivers.can.readings import Readings
from levid.wire.can.can_bus import _MessageBus, open_bus
from levid.wire.can.can_frames import load_frames
from levid.wire.can.kernel_frame import ReceivedFrame, unpack_frame

CONFIG = CanBus(interface="virtual", channel="readings", data_bitrate=5_000_000, stale_cycles=2)


def on_bus(**methods: Any) -> CanLink:
    """A link on a bus with these methods."""
    bus: Any = SimpleNamespace(**methods)
    return CanLink("main", CONFIG, bus)


@pytest.mark.parametrize("late", [False, True])
def test_reading_that_came_after_its_deadline_is_stale(late: bool) -> None:
    link, device = CanLink("main", CONFIG), open_bus(CONFIG)
    link.open()
    try:
        host, frames, out = (
            Readings("sensors", link, load_frames(None, 9, 9, True).gap, 2),
            load_frames(None, 9, 9, True).gap,
            np.full(9, 7.0),
        )
        host.begin(5)
        deadline_s = time.perf_counter() + (-0.001 if late else 3600.0)
        for can_id, data in frames.encode(np.full(9, 1e-4), 5, 0):
            device.send(can_id, data)
        # It is there in either case, and found: what decides is when it came.
        host.collect(deadline_s, out)
        assert host.fresh is not late
        assert host.watch.stale == late
        np.testing.assert_allclose(out, 7.0 if late else 1e-4, atol=2e-8)
    finally:
        link.close()
        device.shutdown()


def test_reading_that_came_late_while_another_was_waited_for_is_stale() -> None:
    """Who waits takes what comes for others of the bus too, and asks when it came for itself."""
    link, device = CanLink("main", CONFIG), open_bus(CONFIG)
    link.open()
    try:
        frames = load_frames(None, 9, 9, True)
        sensors = Readings("sensors", link, frames.gap, 2)
        amplifiers = Readings("amplifiers", link, frames.force, 2)
        for readings in (sensors, amplifiers):
            readings.begin(5)
        for can_id, data in frames.force.encode(np.zeros(9), 5, 0):
            device.send(can_id, data)
        out = np.full(9, 7.0)
        sensors.collect(time.perf_counter() + 0.01, out)
        assert not sensors.fresh
        amplifiers.collect(0.0, out)
        assert not amplifiers.fresh
        assert amplifiers.watch.stale == 1
        np.testing.assert_array_equal(out, 7.0)
    finally:
        link.close()
        device.shutdown()


def test_sets_of_setpoints_are_numbered() -> None:
    """So that the frames of one and those of zero force in the same cycle are told apart."""
    rig, sent = load_rig(shipped("rigs/can.yaml")), []
    link = CanLink("main", CONFIG)
    link.send = lambda _, data: sent.append(data)  # type: ignore[method-assign,assignment]
    frames = load_frames(None, 9, 9, False)
    amplifiers = CanAmplifiers(link, frames, rig, 2, 2, lambda: 0.0)
    for _ in range(17):
        amplifiers.write(np.zeros(9))
    numbers = [frames.setpoint.tag(data) for data in sent]
    assert numbers == [k % 16 for k in range(1, 18) for _ in range(3)]


@pytest.mark.parametrize("lossy", [True, False])
def test_frame_that_does_not_leave_is_lost_on_a_network_and_the_link_on_a_line(lossy: bool) -> None:
    def send(*_: object) -> None:
        raise can.CanTimeoutError

    bus = _MessageBus(SimpleNamespace(send=send), can.Message, 0.005, lossy)
    with contextlib.nullcontext() if lossy else pytest.raises(TimeoutError):
        bus.send(1, b"\0")


def other_frame(kind: str, stamp_s: float) -> ReceivedFrame | None:
    """What a bus makes of a frame that is none of ours and came at `stamp_s`."""
    if kind == "error of the kernel":
        return unpack_frame(struct.pack("=IBB2x8s", 0x2000_0004, 8, 0, bytes(8)), stamp_s)
    wrong = {"is_error_frame": kind == "error", "is_extended_id": kind == "extended"}
    message = can.Message(timestamp=stamp_s, arbitration_id=4, **wrong)
    raw = SimpleNamespace(recv=lambda _: message)
    return _MessageBus(raw, can.Message, None).receive(0.0)


@pytest.mark.parametrize("kind", ["error of the kernel", "error", "extended"])
def test_frame_of_something_else_takes_nothing_from_those_that_came_in_time(kind: str) -> None:
    """A controller tells of an error as a frame; this process was late, the answers were not."""
    frames, out = load_frames(None, 9, 9, True).gap, np.zeros(9)
    stamp_s, deadline_s = time.time() - 0.03, time.perf_counter() - 0.01
    coming = [other_frame(kind, stamp_s)]
    coming += [ReceivedFrame(*frame, stamp_s) for frame in frames.encode(np.full(9, 1e-4), 5, 0)]
    link = on_bus(receive=lambda _: coming.pop(0) if coming else None)
    host = Readings("sensors", link, frames, 2)
    host.begin(5)
    host.collect(deadline_s, out)
    assert host.fresh


@pytest.mark.parametrize("whole", [False, True])
def test_readings_are_not_waited_for_on_a_bus_that_is_busy(whole: bool) -> None:
    """Beyond the deadline there is always one more frame of something else."""
    frames, out = load_frames(None, 9, 9, True).gap, np.zeros(9)
    coming = [ReceivedFrame(*frame, time.time()) for frame in frames.encode(np.full(9, 1e-4), 5, 0)]

    def receive(_: float) -> ReceivedFrame:
        return coming.pop() if coming and whole else ReceivedFrame(0x7F0, b"", time.time())

    host = Readings("sensors", on_bus(receive=receive), frames, 2)
    host.begin(5)
    host.collect(time.perf_counter() + 0.05, out)
    assert host.fresh is whole


@pytest.mark.parametrize(
    ("error", "words"),
    [
        (OSError(errno.ENETDOWN, "Network is down"), "Network is down"),
        (can.CanTimeoutError(), "CanTimeoutError"),
    ],
)
def test_bus_that_is_lost_is_shut_down_after_the_cycle(error: Exception, words: str) -> None:
    """Some interfaces wait for a thread; other buses still wait for zero force."""
    done: list[str] = []

    def send(*_: object) -> None:
        raise error

    link = on_bus(send=send, shutdown=lambda: done.append("shut down"))
    with pytest.raises(LinkError, match=f"sending failed: .*{words}"):
        link.send(1, b"")
    with pytest.raises(LinkError, match="not open"):
        link.send(1, b"")
    assert not done
    link.open()
    assert done == ["shut down"]
    link.close()


def test_two_loops_do_not_fly_on_one_bus(tmp_path: Path) -> None:
    """The second would reset what the first has tripped, and home its drives in flight."""
    bus = CanBus(interface="levid_local", channel=str(tmp_path))
    is_for_one_loop(CanLink("main", bus), CanLink("main", bus))


@pytest.mark.parametrize("folder", ["/" + 30 * "long-", "/\N{GREEK SMALL LETTER MU}" + 60 * "\xe4"])
def test_claims_of_long_names_are_told_apart(folder: str) -> None:
    one, other, again = (
        BusLock(f"{folder}/force"),
        BusLock(f"{folder}/motion"),
        BusLock(f"{folder}/force"),
    )
    assert one.acquire()
    assert other.acquire()
    assert not again.acquire()
    for claim in (one, other):
        claim.release()


def test_bus_that_cannot_be_claimed_is_not_said_to_be_somebody_else_s(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """No memory, or no descriptor left: nobody else flies."""
    link = CanLink("main", CanBus(interface="levid_local", channel=str(tmp_path)))
    refusing = SimpleNamespace(bind=refuse, close=lambda: None)
    monkeypatch.setattr("levid.drivers.bus_lock.socket.socket", lambda *_: refusing)
    with pytest.raises(LinkError, match=r"cannot be locked: .*no room"):
        link.open()


def refuse(_: object) -> None:
    raise OSError(errno.ENOMEM, "no room")
