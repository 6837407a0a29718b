"""A CAN reading counts if its timestamp is before the deadline, whenever this process reads it."""

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
from bus_lock_checks import is_for_one_loop

from levid.config.buses import CanBus
from levid.config.rig import load_rig
from levid.config.shipped import shipped
from levid.drivers.base import LinkError
from levid.drivers.bus_lock import BusLock
from levid.drivers.can.amplifiers_and_adc import CanAmplifiers
from levid.drivers.can.bus_link import CanLink
from levid.drivers.can.reading_collector import Readings
from levid.wire.can.can_bus import _MessageBus, open_bus
from levid.wire.can.can_frames import load_frames
from levid.wire.can.kernel_frame import ReceivedFrame, unpack_frame

CONFIG = CanBus(interface="virtual", channel="readings", data_bitrate=5_000_000, stale_cycles=2)


def on_bus(**methods: Any) -> CanLink:
    """A link on a bus with these methods."""
    bus: Any = SimpleNamespace(**methods)
    return CanLink("main", CONFIG, bus)


@pytest.mark.parametrize("late", [False, True])
def test_reading_after_its_deadline_is_stale(late: bool) -> None:
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
        # It has arrived in either case; its timestamp decides.
        host.collect(deadline_s, out)
        assert host.fresh is not late
        assert host.watch.stale == late
        np.testing.assert_allclose(out, 7.0 if late else 1e-4, atol=2e-8)
    finally:
        link.close()
        device.shutdown()


def test_late_reading_received_during_another_wait_is_stale() -> None:
    """A wait dispatches frames of other devices too, each with its own timestamp."""
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
    """So that a set is distinct from the immediate zero force of the same cycle."""
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
def test_send_timeout_loses_a_frame_on_a_network_and_the_link_on_a_line(lossy: bool) -> None:
    def send(*_: object) -> None:
        raise can.CanTimeoutError

    bus = _MessageBus(SimpleNamespace(send=send), can.Message, 0.005, lossy)
    with contextlib.nullcontext() if lossy else pytest.raises(TimeoutError):
        bus.send(1, b"\0")


def other_frame(kind: str, stamp_s: float) -> ReceivedFrame | None:
    """Return what a bus makes of a foreign frame that arrived at `stamp_s`."""
    if kind == "error of the kernel":
        return unpack_frame(struct.pack("=IBB2x8s", 0x2000_0004, 8, 0, bytes(8)), stamp_s)
    wrong = {"is_error_frame": kind == "error", "is_extended_id": kind == "extended"}
    message = can.Message(timestamp=stamp_s, arbitration_id=4, **wrong)
    raw = SimpleNamespace(recv=lambda _: message)
    return _MessageBus(raw, can.Message, None).receive(0.0)


@pytest.mark.parametrize("kind", ["error of the kernel", "error", "extended"])
def test_foreign_frame_does_not_end_the_read_of_frames_in_time(kind: str) -> None:
    """A controller reports errors as frames; the answers came in time, and are read late."""
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
def test_readings_are_not_awaited_beyond_the_deadline_on_a_busy_bus(whole: bool) -> None:
    """After the deadline there is always one more foreign frame."""
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
def test_lost_bus_is_shut_down_after_the_cycle(error: Exception, words: str) -> None:
    """Some interfaces wait for a thread when closed; other buses still need zero force."""
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


def test_second_loop_on_a_bus_is_refused(tmp_path: Path) -> None:
    """A second loop would reset trips and home the drives in flight."""
    bus = CanBus(interface="levid_local", channel=str(tmp_path))
    is_for_one_loop(CanLink("main", bus), CanLink("main", bus))


@pytest.mark.parametrize("folder", ["/" + 30 * "long-", "/\N{GREEK SMALL LETTER MU}" + 60 * "\xe4"])
def test_locks_of_long_names_differ(folder: str) -> None:
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


def test_failed_lock_is_not_reported_as_another_loop(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without memory or descriptors the lock fails too."""
    link = CanLink("main", CanBus(interface="levid_local", channel=str(tmp_path)))
    monkeypatch.setattr("levid.drivers.bus_lock.fcntl.flock", refuse)
    with pytest.raises(LinkError, match=r"cannot be locked: .*no room"):
        link.open()


def refuse(*_: object) -> None:
    raise OSError(errno.ENOMEM, "no room")
