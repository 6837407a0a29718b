"""The serial decoder accepts exactly the blocks that zlib and struct accept, with their numbers."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st
from independent_frame_decoder import (
    CHANGES,
    SERIAL_BODIES,
    changed,
    serial_frame,
    serial_sealed,
    unstuffed,
)
from serial_frame_fuzz_checks import BODIES, CONTENTS, frame, numbers_right

from levid.wire.serial.serial_frames import Header, Kind, SerialFrames

FRAMES = SerialFrames(CONTENTS)


def judge(block: bytes) -> None:
    header, expected = FRAMES.accept(block), serial_frame(block)
    if expected is None:
        assert not isinstance(header, Header)
        return
    kind, number, body = expected
    assert header == Header(Kind(kind), number)
    assert numbers_right(FRAMES, kind, body)


@given(st.sampled_from(Kind), st.integers(0, 0xFFFF), BODIES, CHANGES)
def test_changed_frame_is_accepted_only_if_right(kind, number, noise: bytes, changes) -> None:
    good = frame(kind, number, noise)
    judge(good)
    judge(changed(good, changes))


@given(st.sampled_from(Kind), st.integers(0, 0xFFFF), BODIES, CHANGES)
def test_right_checksum_alone_is_not_enough(kind, number, noise: bytes, changes) -> None:
    judge(serial_sealed(changed(unstuffed(frame(kind, number, noise))[:-4], changes)))


@given(st.sampled_from(Kind), st.integers(0, 0xFFFF), BODIES)
def test_any_body_gives_its_numbers(kind: Kind, number: int, noise: bytes) -> None:
    """Numbers that levid does not send, such as nan and infinite velocities, among them."""
    head = bytes((1, kind, number & 0xFF, number >> 8))
    judge(serial_sealed(head + noise[: SERIAL_BODIES[kind]]))


@given(st.binary(max_size=120))
def test_noise_is_accepted_only_if_right(block: bytes) -> None:
    judge(block)
