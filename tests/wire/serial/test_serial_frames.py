"""The serial protocol, byte by byte as docs/serial-protocol.md has it, and its stream of frames."""

from __future__ import annotations

import struct
import zlib

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from levid.wire.frame_rejection_reasons import Rejected
from levid.wire.serial import cobs
from levid.wire.serial.frame_splitter import FrameStream
from levid.wire.serial.serial_frames import FrameContents, Header, Kind, SerialFrames

ALL = FrameContents(9, 9, True)
GAP_M = 2e-3 / 65536
NONE = np.zeros((3, 3))


def stuffed(data: bytes) -> bytes:
    out = np.zeros(cobs.encoded_length(len(data)), np.uint8)
    return out[: cobs.encode(np.frombuffer(data, np.uint8), out)].tobytes()


def unstuffed(data: bytes, room: int = 4096) -> bytes | None:
    out = np.zeros(room, np.uint8)
    n = cobs.decode(np.frombuffer(data, np.uint8), out)
    return None if n < 0 else out[:n].tobytes()


@pytest.mark.parametrize(
    ("data", "encoded"),
    [
        # examples of Cheshire and Baker's encoding
        (b"\x00", "01 01 00"),
        (b"\x00\x00", "01 01 01 00"),
        (b"\x11\x22\x00\x33", "03 11 22 02 33 00"),
        (b"\x11\x22\x33\x44", "05 11 22 33 44 00"),
        (b"\x11\x00\x00\x00", "02 11 01 01 01 00"),
        (bytes(range(1, 255)), "ff " + bytes(range(1, 255)).hex(" ") + " 00"),
        (bytes(range(1, 256)), "ff " + bytes(range(1, 255)).hex(" ") + " 02 ff 00"),
    ],
)
def test_stuffing_is_that_of_the_paper(data: bytes, encoded: str) -> None:
    assert stuffed(data).hex(" ") == encoded
    assert unstuffed(bytes.fromhex(encoded)[:-1]) == data


@given(st.binary(min_size=0, max_size=1200))
def test_stuffing_is_undone_and_leaves_no_zero(data: bytes) -> None:
    encoded = stuffed(data)
    assert 0 not in encoded[:-1]
    assert encoded[-1] == 0
    assert len(encoded) <= cobs.encoded_length(len(data))
    assert unstuffed(encoded[:-1]) == data


@given(st.binary(max_size=80))
def test_nonsense_is_no_encoding_or_fits(data: bytes) -> None:
    found = unstuffed(data, room=20)
    assert found is None or len(found) <= 20


def test_cycle_frame_byte_by_byte() -> None:
    frames = SerialFrames(FrameContents(3, 0, True))
    sent = frames.cycle(
        0x1234,
        np.array([1.0, -2.0, np.nan]),
        np.array([0.05, 0.1, -2.0]),
        np.array([1.0, 0.5, 3.0]),
    )
    raw = unstuffed(sent[:-1])
    assert raw is not None
    head = struct.pack("<BBH", 1, 0x01, 0x1234)
    body = struct.pack("<3h", 1000, -2000, -32768)
    body += struct.pack("<iffiff", 50_000_000, 0.1, -2.0, 10_000_000, 0.5, 3.0)
    assert raw == head + body + struct.pack("<I", zlib.crc32(head + body))


def test_readings_frame_byte_by_byte() -> None:
    frames = SerialFrames(FrameContents(2, 2, True))
    axes = np.array([[0.01, 0.2, 1.5], [0.01, 0.2, 1.25], [0.5, -1.0, 0.125]])
    sent = frames.readings(
        9, (1, np.array([3.0, np.nan])), (1, np.array([GAP_M, np.nan])), (2, 0x7305, axes)
    )
    raw = unstuffed(sent[:-1])
    assert raw is not None
    head = struct.pack("<BBH", 1, 0x81, 9)
    body = struct.pack("<BB2h", 1, 0, 3000, -32768) + struct.pack("<BB2h", 1, 0, 1, -32768)
    body += struct.pack("<BBH", 2, 0, 0x7305)
    body += struct.pack("<iffiffiff", 10**7, 0.2, 1.5, 10**7, 0.2, 1.25, 5 * 10**6, -1.0, 0.125)
    assert raw == head + body + struct.pack("<I", zlib.crc32(head + body))


@pytest.mark.parametrize("contents", [ALL, FrameContents(9, 9, False), FrameContents(0, 0, True)])
def test_what_is_sent_is_received(contents: FrameContents) -> None:
    host, device = SerialFrames(contents), SerialFrames(contents)
    coil = np.linspace(-20, 20, contents.coils)
    beam, rotor = np.array([0.05, 0.25, -1.5]), np.array([1.0, 0.5, 2.5])
    sent = host.cycle(70_000, coil, beam, rotor)
    assert device.accept(sent[:-1]) == Header(Kind.CYCLE, 70_000 % 65_536)
    if contents.coils:
        out = np.zeros(contents.coils)
        device.setpoints(out)
        np.testing.assert_allclose(out, coil, atol=0.5001e-3)
    if contents.drives:
        found = np.zeros(3), np.zeros(3)
        device.drive_setpoints(*found)
        # positions in whole counts, the others as floats of 24 bits
        np.testing.assert_allclose(found, (beam, rotor), rtol=1e-7, atol=1e-9)


def test_position_that_is_no_number_arrives_as_none() -> None:
    frames, axes = SerialFrames(ALL), np.array([[0.1, 1.0, 2.0], [np.nan, 3.0, 4.0], [-0.1] * 3])
    sent = frames.readings(1, (1, np.zeros(9)), (0, np.zeros(9)), (2, 0, axes))
    assert isinstance(frames.accept(sent[:-1]), Header)
    found = np.zeros((3, 3))
    assert frames.drive_readings(found) == (2, 0)
    np.testing.assert_allclose(found, axes, rtol=1e-6)  # 32 bits each


def test_frames_that_do_not_count_say_why() -> None:
    frames = SerialFrames(ALL)
    good = unstuffed(frames.request(1, 1, 0)[:-1])
    assert good is not None

    def with_crc(data: bytes) -> bytes:
        return stuffed(data + struct.pack("<I", zlib.crc32(data)))[:-1]

    body = good[:-4]
    assert frames.accept(with_crc(body)) == Header(Kind.REQUEST, 1)
    assert frames.accept(with_crc(b"\x02" + body[1:])) is Rejected.VERSION
    assert frames.accept(with_crc(body[:1] + b"\x7f" + body[2:])) is Rejected.KIND
    assert frames.accept(with_crc(body + b"\x00")) is Rejected.LENGTH
    assert frames.accept(stuffed(good[:-1] + bytes([good[-1] ^ 1]))[:-1]) is Rejected.CHECKSUM
    assert frames.accept(stuffed(b"abc")[:-1]) is Rejected.LENGTH
    assert frames.accept(b"\x09abc") is Rejected.FRAMING
    assert frames.accept(b"") is Rejected.FRAMING


def test_cycles_beyond_those_that_are_counted_do_not_count() -> None:
    """Requests and answers may have any number."""
    frames, none = SerialFrames(ALL), np.zeros(9)

    def judged(sequence: int) -> list[Header | Rejected]:
        sent = [
            frames.cycle(sequence, none, none[:3], none[:3]),
            frames.readings(sequence, (0, none), (0, none), (0, 0, np.zeros((3, 3)))),
            frames.request(sequence, 1, 0),
            frames.answer(sequence, 0, 1),
        ]
        return [frames.accept(frame[:-1]) for frame in sent]

    kinds = [Kind.CYCLE, Kind.READINGS, Kind.REQUEST, Kind.ANSWER]
    assert judged(61_439) == [Header(kind, 61_439) for kind in kinds]
    for beyond in (61_440, 65_535):
        whole = [Header(kind, beyond) for kind in kinds[2:]]
        assert judged(beyond) == [Rejected.CYCLE, Rejected.CYCLE, *whole]


@given(st.binary(max_size=60), st.integers(1, 7))
def test_stream_is_in_step_again_by_the_next_whole_frame(noise: bytes, step: int) -> None:
    frames = SerialFrames(ALL)
    frame = frames.request(3, 1, 2)
    stream = FrameStream(frames.longest)
    # Whatever came before: its end is the next zero, which one frame at most is lost to.
    data = noise + frame + frame
    blocks = [b for i in range(0, len(data), step) for b in stream.feed(data[i : i + step])]
    assert frames.accept(blocks[-1]) == Header(Kind.REQUEST, 3)


def test_endless_block_is_thrown_away_in_bounded_memory() -> None:
    stream = FrameStream(32)
    for _ in range(1000):
        assert stream.feed(b"\x01" * 100) == []
    assert len(stream._rest) <= 33
    assert stream.feed(b"\x00\x02\x07\x00") == [b"\x02\x07"]
    assert stream.overlong == 1
