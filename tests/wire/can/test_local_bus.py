"""A bus between processes of one host: everybody hears everybody else, whoever comes or goes."""

from __future__ import annotations

import os
import signal
import socket
import struct
import subprocess
import sys
import threading
import time
from pathlib import Path

import can
import pytest

from levid.wire.can.kernel_frame import SO_TIMESTAMPNS, kernel_stamp_s, unpack_frame
from levid.wire.can.local_bus import LocalBus, LocalFrames

WAIT_S = 30.0
CHILD = """
import sys
from pathlib import Path
from levid.wire.can.local_bus import LocalFrames
bus = LocalFrames(Path(sys.argv[1]), True)
bus.send(0x7F, b"here")
print("on", flush=True)
while True:
    bus.receive(1.0)
"""


def joined(folder: Path, n: int) -> list[LocalFrames]:
    """Return so many that have noticed each other."""
    buses = [LocalFrames(folder, True) for _ in range(n)]
    for _ in buses:
        for bus in buses:
            bus.receive(0.001)
    return buses


def heard(bus: LocalFrames) -> tuple[int, bytes]:
    """Return the next frame; who comes and goes is none."""
    while True:
        frame = bus.receive(WAIT_S)
        assert frame is not None
        if frame.can_id >= 0:
            return frame.can_id, frame.data


def test_all_others_hear_a_frame_and_who_sends_does_not(tmp_path: Path) -> None:
    buses = joined(tmp_path / "bus", 3)
    for n, bus in enumerate(buses):
        bus.send(0x100 + n, bytes(20))
        for other in buses:
            if other is not bus:
                assert heard(other) == (0x100 + n, bytes(20))
    for bus in buses:
        assert bus.receive(0.0) is None
        bus.shutdown()
    assert list((tmp_path / "bus").iterdir()) == []


@pytest.mark.parametrize(("room", "length"), [(8, 9), (8, 64), (64, 65), (64, 255)])
def test_frame_that_claims_more_than_it_has_is_none_of_ours(room: int, length: int) -> None:
    head = struct.pack("=IBB2x", 0x123, length, 0)
    assert unpack_frame(head + bytes(room), 1.0) == (-1, b"", 1.0)
    assert unpack_frame(struct.pack("=IBB2x", 0x123, room, 0) + bytes(room), 1.0).data == bytes(
        room
    )


def test_frame_is_stamped_when_it_comes_and_not_when_it_is_looked_at(tmp_path: Path) -> None:
    here, there = joined(tmp_path / "bus", 2)
    for sender, receiver in ((here, there), (there, here)):  # who was joined, and who did join
        before_s = time.time()
        sender.send(0x100, bytes(8))
        after_s = time.time()
        time.sleep(0.02)
        frame = receiver.receive(WAIT_S)
        assert frame is not None
        # The kernel's clock goes in steps of its own, none longer than a tick of 10 ms.
        assert before_s - 0.01 <= frame.stamp_s <= after_s + 0.01
    for bus in (here, there):
        bus.shutdown()


def test_many_that_join_at_once_are_on_one_bus(tmp_path: Path) -> None:
    buses: list[LocalFrames] = []
    threads = [
        threading.Thread(target=lambda: buses.append(LocalFrames(tmp_path, True))) for _ in range(8)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    for bus in buses:
        bus.receive(0.001)  # lets in who came
    for _ in buses:
        for bus in buses:
            bus.receive(0.001)
    buses[0].send(0x123, b"once")
    for bus in buses[1:]:
        assert heard(bus) == (0x123, b"once")
        assert bus.receive(0.0) is None
    for bus in buses:
        bus.shutdown()


def test_who_was_killed_leaves_nothing_that_the_next_stumbles_over(tmp_path: Path) -> None:
    ours = LocalFrames(tmp_path, True)
    for _ in range(2):
        child = subprocess.Popen(
            [sys.executable, "-c", CHILD, str(tmp_path)], stdout=subprocess.PIPE, text=True
        )
        assert child.stdout is not None
        assert child.stdout.readline() == "on\n"
        assert heard(ours) == (0x7F, b"here")
        os.kill(child.pid, signal.SIGKILL)
        child.wait()
        ours.send(0x001, b"to nobody")
    assert ours.receive(0.001) is None
    assert len(list(tmp_path.iterdir())) == 2  # ours, and what the last one left
    ours.shutdown()


def test_what_is_no_socket_is_left_alone(tmp_path: Path) -> None:
    """Somebody may keep other things in the folder, by a name that ends as ours do."""
    kept, link, folder = (tmp_path / f"{name}.can" for name in ("kept", "link", "folder"))
    kept.write_text("a log")
    link.symlink_to(tmp_path / "nowhere")
    folder.mkdir()
    one, other = joined(tmp_path, 2)
    assert kept.read_text() == "a log"
    assert link.is_symlink()
    one.send(0x123, b"heard")
    assert heard(other) == (0x123, b"heard")
    for bus in (one, other):
        bus.shutdown()


def test_who_does_not_read_delays_nobody(tmp_path: Path) -> None:
    sender, deaf, other = joined(tmp_path, 3)
    for n in range(5000):
        sender.send(0x200, n.to_bytes(2, "little"))
        assert heard(other) == (0x200, n.to_bytes(2, "little"))
    assert heard(deaf) == (0x200, bytes(2))  # the first ones are there, the rest is lost
    for bus in (sender, deaf, other):
        bus.shutdown()


def test_who_joins_a_busy_bus_hears_and_is_heard_at_once(tmp_path: Path) -> None:
    """Members for whom a frame waits always, or who only send, take in the late one too."""
    busy, talker, silent = joined(tmp_path, 3)
    for n in range(100):  # frames wait at all times
        talker.send(0x100, n.to_bytes(2, "little"))
    late = LocalFrames(tmp_path, True)
    late.send(0x200, b"late")
    assert (0x200, b"late") in [heard(busy) for _ in range(4)]  # one turn of all members
    talker.send(0x300, b"to all")  # it never received since the late one came
    assert heard(late) == (0x300, b"to all")
    again = LocalFrames(tmp_path, True)
    silent.receive(0.0)  # a poll that does not wait
    silent.send(0x400, b"me too")
    assert heard(again) == (0x400, b"me too")
    for bus in (busy, talker, silent, late, again):
        bus.shutdown()


def test_who_floods_the_bus_does_not_silence_the_others(tmp_path: Path) -> None:
    receiver, flood, quiet = joined(tmp_path, 3)
    for bus in (flood, quiet):
        for _ in range(10):
            bus.send(0x100 if bus is flood else 0x200, bytes(8))
    first = [heard(receiver)[0] for _ in range(4)]
    assert first.count(0x100) == first.count(0x200) == 2
    for bus in (receiver, flood, quiet):
        bus.shutdown()


def test_who_was_stopped_while_many_came_is_reached_when_it_goes_on(tmp_path: Path) -> None:
    stopped = LocalFrames(tmp_path, True)
    for _ in range(40):  # more than its row of those who wait
        LocalFrames(tmp_path, True).shutdown()
    late = LocalFrames(tmp_path, True)
    late.send(0x100, b"lost")
    stopped.receive(0.001)  # it goes on, and lets in those who waited
    late._retry_s = 0.0
    late.send(0x101, b"heard")
    assert heard(stopped) == (0x101, b"heard")
    for bus in (stopped, late):
        bus.shutdown()


def test_classic_bus_does_not_hear_can_fd(tmp_path: Path) -> None:
    classic, fd = LocalFrames(tmp_path, False), LocalFrames(tmp_path, True)
    classic.receive(0.001)
    fd.send(0x010, bytes(20))
    fd.send(0x011, bytes(8))
    assert heard(classic) == (0x011, bytes(8))
    for bus in (classic, fd):
        bus.shutdown()


def test_tools_of_python_can_are_on_the_same_bus(tmp_path: Path) -> None:
    frames = LocalFrames(tmp_path, True)
    with can.Bus(interface="levid_local", channel=str(tmp_path), fd=True) as bus:
        assert isinstance(bus, LocalBus)
        frames.receive(0.001)
        frames.send(0x123, bytes(range(20)))
        message = bus.recv(WAIT_S)
        assert message is not None
        assert (message.arbitration_id, bytes(message.data)) == (0x123, bytes(range(20)))
        assert message.is_fd
        bus.send(can.Message(arbitration_id=0x321, is_extended_id=False, data=b"ab"))
        assert heard(frames) == (0x321, b"ab")
        with pytest.raises(can.CanOperationError, match="11-bit"):
            bus.send(can.Message(arbitration_id=0x321, is_extended_id=True))
    frames.shutdown()


def test_what_is_no_frame_is_nobody_s(tmp_path: Path) -> None:
    one, other = joined(tmp_path, 2)
    (end,) = one._peers
    for size in (1, 7, 15, 17, 71, 73, 200):
        end.send(bytes(size))
        frame = other.receive(WAIT_S)
        assert frame is not None
        assert frame.can_id == -1
    one.send(0x123, b"whole")
    assert heard(other) == (0x123, b"whole")
    for bus in (one, other):
        bus.shutdown()


def test_handles_that_somebody_sends_along_are_no_stamp() -> None:
    """They come alone where the kernel stamps nothing; four of them are as long as a stamp."""
    for handles in (1, 4):
        numbers = struct.pack(f"{handles}i", *range(1, handles + 1))
        sent = socket.SOL_SOCKET, socket.SCM_RIGHTS, numbers
        assert kernel_stamp_s([sent]) == 0.0
    stamp = (socket.SOL_SOCKET, SO_TIMESTAMPNS, struct.pack("@ll", 7, 500_000_000))
    assert kernel_stamp_s([sent, stamp]) == 7.5


def test_bus_in_a_folder_of_everybody_is_refused(tmp_path: Path) -> None:
    tmp_path.chmod(0o777)
    with pytest.raises(can.CanInitializationError, match="expected a private folder"):
        can.Bus(interface="levid_local", channel=str(tmp_path))


def test_folder_that_cannot_be_is_told(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(can.CanInitializationError, match="expected a folder"):
        can.Bus(interface="levid_local", channel=str(tmp_path / "file"))


def test_one_that_is_stopped_keeps_nobody_from_joining(tmp_path: Path) -> None:
    # It takes nobody in: its row of those who wait is full after sixteen.
    folder = tmp_path / "bus"
    stopped = LocalFrames(folder, True)
    done = threading.Event()

    def join_often() -> None:
        for _ in range(40):
            LocalFrames(folder, True).shutdown()
        done.set()

    threading.Thread(target=join_often, daemon=True).start()
    assert done.wait(WAIT_S)
    stopped.shutdown()
