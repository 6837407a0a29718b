"""Noise in the kernel's layout of a CAN frame becomes a frame only where linux/can.h has one."""

from __future__ import annotations

import socket
import struct
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from levid.wire.can.kernel_frame import (
    ERROR_BUS_OFF,
    FRAME_SIZES,
    OTHER,
    BusOffError,
    ReceivedFrame,
    unpack_frame,
)
from levid.wire.can.local_bus import LocalFrames

EFF, RTR, ERR = 0x8000_0000, 0x4000_0000, 0x2000_0000
"""linux/can.h: flags in the ID of a frame."""


@st.composite
def raw_frames(draw, sizes: st.SearchStrategy[int]) -> bytes:
    """Noise; in half of it a right ID, in half a length that some frame has."""
    size = draw(sizes)
    raw = bytearray(draw(st.binary(min_size=size, max_size=size)))
    if draw(st.booleans()):
        raw[0:4] = struct.pack("=I", draw(st.integers(0, 0x7FF)))
    if draw(st.booleans()):
        raw[4:5] = bytes((draw(st.integers(0, 64)),))
    return bytes(raw[:size])


def laid_out(raw: bytes) -> ReceivedFrame | None:
    """Return the frame by linux/can.h, OTHER for none, None for bus-off."""
    can_id = int.from_bytes(raw[:4], "little")
    if can_id & ERR and can_id & ERROR_BUS_OFF:
        return None
    if can_id & (EFF | RTR | ERR):
        return OTHER
    return ReceivedFrame(can_id, raw[8 : 8 + raw[4]], 0.0) if raw[4] <= len(raw) - 8 else OTHER


@given(raw_frames(st.sampled_from(FRAME_SIZES)))
def test_frame_from_the_kernel_is_that_of_linux(raw: bytes) -> None:
    try:
        found: ReceivedFrame | None = unpack_frame(raw, 0.0)
    except BusOffError:
        found = None
    assert found == laid_out(raw)


@pytest.fixture(params=[False, True], ids=["classic", "fd"])
def bus(request, tmp_path: Path) -> Iterator[tuple[LocalFrames, socket.socket, bool]]:
    """A bus, a process' own connection to it, and whether it is CAN FD."""
    frames = LocalFrames(tmp_path, request.param)
    (path,) = tmp_path.glob("*.can")
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as other:
        other.connect(str(path))
        frames.receive(1.0)  # accepts the connection
        yield frames, other, request.param
    frames.shutdown()


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(raw=raw_frames(st.one_of(st.sampled_from(FRAME_SIZES), st.integers(1, 80))))
def test_message_on_a_local_bus_is_a_frame_or_ignored(bus, raw: bytes) -> None:
    frames, other, fd = bus
    other.send(raw)
    try:
        found: ReceivedFrame | None = frames.receive(10.0)
        assert found is not None
    except BusOffError:
        found = None
    right = laid_out(raw) if len(raw) in FRAME_SIZES else OTHER
    if right is not None and len(right.data) > 8 and not fd:
        right = OTHER
    assert (found and found[:2]) == (right and right[:2])  # the kernel gives the time
