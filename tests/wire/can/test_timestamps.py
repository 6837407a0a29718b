"""When a frame came: by hardware's stamp where there is one, else by the kernel's."""

from __future__ import annotations

import socket
import struct
import time
from itertools import count

import numpy as np
import pytest

from levid.wire.can.can_bus import Ages, _KernelBus
from levid.wire.can.kernel_frame import SO_TIMESTAMPNS, ReceivedFrame, pack_frame
from levid.wire.can.timestamps import SO_TIMESTAMPING, Ancillary, KernelStamps

WAIT_S = 30.0


def stamped(kernel_s: float, hardware_s: float = 0.0) -> Ancillary:
    """Return what the kernel lays beside a frame that was asked for both kinds of stamps."""
    three = [0] * 6
    for at, stamp_s in ((0, kernel_s), (4, hardware_s)):
        three[at], three[at + 1] = int(stamp_s), round(1e9 * (stamp_s % 1.0))
    one = struct.pack("@ll", *three[:2])
    more = struct.pack("@llllll", *three)
    return [(socket.SOL_SOCKET, SO_TIMESTAMPNS, one), (socket.SOL_SOCKET, SO_TIMESTAMPING, more)]


@pytest.fixture
def pair():
    """Two sockets that know each other, on this host."""
    ends = [socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(2)]
    for end in ends:
        end.bind(("127.0.0.1", 0))
    ends[0].connect(ends[1].getsockname())
    ends[1].connect(ends[0].getsockname())
    yield ends
    for end in ends:
        end.close()


@pytest.fixture
def stamps(pair) -> KernelStamps:
    return KernelStamps(pair[0])


def test_stamps_of_hardware_tell_how_long_a_frame_has_waited(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A clock of its own, 50 ppm slow; frames wait for 0.1 ms and more, one for 20."""
    now_s = [1.7e5]
    monkeypatch.setattr("levid.wire.can.can_bus.perf_counter", lambda: now_s[0])
    ages, rng, found = Ages("gs_usb"), np.random.default_rng(1), []
    for k in range(60_000):
        at_s = 1e-3 * k
        waited_s = 0.02 if k == 59_999 else 1e-4 + float(rng.exponential(1e-4))
        now_s[0] = 1.7e5 + at_s + waited_s
        found.append((ages.of(5.0 + (1.0 - 5e-5) * at_s), waited_s))
    told, waited = np.array(found[100:]).T
    # The quickest of two seconds is of no age: 0.1 ms too little, and up to 0.1 more for the drift.
    assert np.all(told <= waited - 1e-4 + 50e-6 * 2.0 + 1e-6)
    assert np.all(told >= waited - 1.2e-4)
    assert ages.of(1.0) is None  # the counter begins anew
    now_s[0] += 1e-3
    assert ages.of(1.001) == pytest.approx(0.0, abs=1e-6)
    assert ages.of(0.0) is None


def test_hardware_of_the_kernels_own_interfaces_is_followed(
    stamps: KernelStamps, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The kernel gets to a frame when it can, and this process later still: hardware knew before.

    It is 30 ppm fast; the time of day is set by half a second on the way, which moves no frame.
    """
    clock_s, day_s = [7e4], [1.8e9]
    monkeypatch.setattr("levid.wire.can.timestamps.perf_counter", lambda: clock_s[0])
    monkeypatch.setattr("levid.wire.can.timestamps.time", lambda: day_s[0] + clock_s[0])
    rng, wrong = np.random.default_rng(2), []
    for k in range(20_000):
        received_s = 7e4 + 1e-3 * k
        kernel_s = received_s + 5e-5 + (0.012 if k % 50 == 49 else float(rng.exponential(1e-5)))
        clock_s[0] = kernel_s + float(rng.uniform(0.0, 3e-3))
        if k == 15_000:
            day_s[0] += 0.5
        beside = stamped(kernel_s + day_s[0], 3.0 + (1.0 + 30e-6) * 1e-3 * k)
        wrong.append(stamps.received_s(beside) - day_s[0] - received_s)
    # The quickest is of no age: 0.05 ms too late, and the drift of two seconds. A double of a time
    # of day has steps of 0.24 us.
    assert min(wrong[2_000:]) > 5e-5 - 60e-6 - 1e-6
    assert max(wrong[2_000:]) < 5e-5 + 60e-6 + 1e-6


def test_frame_without_a_stamp_of_hardware_counts_by_the_kernels(stamps: KernelStamps) -> None:
    """Both may come from one interface: a driver's own error frames have no time on the wire."""
    now_s = time.time()
    assert stamps.received_s(stamped(now_s, 5.0)) == pytest.approx(now_s, abs=1e-6)
    assert stamps.received_s(stamped(now_s - 0.25)) == pytest.approx(now_s - 0.25, abs=1e-6)
    (only, _) = stamped(now_s - 0.5)
    assert stamps.received_s([only]) == pytest.approx(now_s - 0.5, abs=1e-6)


def test_hardware_alone_is_followed_by_when_frames_are_read(stamps: KernelStamps) -> None:
    before_s = time.time()
    assert stamps.received_s(stamped(0.0, 5.0)) >= before_s
    # 0.2 s older on hardware's clock, and read later: so much older on this host's.
    received_s = stamps.received_s(stamped(0.0, 4.8))
    assert before_s - 0.2 - 1e-6 <= received_s <= time.time() - 0.2 + 1e-6


@pytest.mark.parametrize("data", [b"", bytes(8), bytes(15), bytes(17), bytes(40), bytes(49)])
@pytest.mark.parametrize("kind", [SO_TIMESTAMPNS, SO_TIMESTAMPING])
def test_what_is_no_stamp_is_none(stamps: KernelStamps, kind: int, data: bytes) -> None:
    assert stamps.received_s([(socket.SOL_SOCKET, kind, data)]) == 0.0
    assert stamps.received_s([(socket.SOL_SOCKET, socket.SCM_RIGHTS, data)]) == 0.0
    assert stamps.received_s([]) == 0.0


@pytest.mark.parametrize("asked_before", [False, True])
def test_kernel_says_when_a_frame_came(pair: list[socket.socket], asked_before: bool) -> None:
    """A real one, over UDP: no vcan is here, and the kernel has one code for either's stamps."""
    here, there = pair
    if asked_before:  # as python-can does
        here.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 1)
    bus = _KernelBus(None, here)
    there.send(pack_frame(0x7F, b""))  # it begins to stamp a little after somebody asks for that
    assert bus.receive(WAIT_S) is not None
    for n in range(10):
        before_s = time.time()
        there.send(pack_frame(0x100 + n, bytes(20)))
        after_s = time.time()
        time.sleep(0.02)
        frame = bus.receive(WAIT_S)
        assert isinstance(frame, ReceivedFrame)
        assert frame[:2] == (0x100 + n, bytes(20))
        # The kernel's clock goes in steps of its own, none longer than a tick of 10 ms.
        assert before_s - 0.01 <= frame.stamp_s <= after_s + 0.01


@pytest.mark.parametrize("refused", [{SO_TIMESTAMPING}, {SO_TIMESTAMPING, SO_TIMESTAMPNS}])
def test_kernel_that_refuses_is_asked_for_less(refused: set[int]) -> None:
    class Old:
        def __init__(self) -> None:
            self.asked: list[int] = []

        def setsockopt(self, _: int, option: int, __: int) -> None:
            if option in refused:
                raise OSError(92, "Protocol not available")
            self.asked.append(option)

    old = Old()
    KernelStamps(old)  # type: ignore[arg-type]
    assert old.asked == [option for option in (SO_TIMESTAMPNS,) if option not in refused]


def test_stamps_go_through_a_socket_that_python_can_has_opened(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """What is late is so by hardware's clock, although the kernel and this process were later."""
    ticks, now_s = count(), time.time()

    class Raw:
        def setsockopt(self, *_: int) -> None: ...

        def recvmsg(self, size: int, room: int, _: int) -> tuple[bytes, Ancillary, int, None]:
            assert size >= 72
            assert room >= sum(socket.CMSG_SPACE(n) for n in (16, 48))
            late_s = 0.02 if next(ticks) else 0.0
            return pack_frame(0x28, bytes(8)), stamped(now_s + 0.001 + late_s, 3.001), 0, None

    monkeypatch.setattr("levid.wire.can.timestamps.time", lambda: now_s + 0.05)
    monkeypatch.setattr("levid.wire.can.timestamps.perf_counter", lambda: 9.0)
    bus = _KernelBus(None, Raw())  # type: ignore[arg-type]
    first, second = bus.receive(0.0), bus.receive(0.0)
    assert first is not None
    assert second is not None
    assert first.stamp_s == pytest.approx(now_s + 0.001, abs=2e-6)
    assert second.stamp_s == pytest.approx(first.stamp_s, abs=2e-6)
