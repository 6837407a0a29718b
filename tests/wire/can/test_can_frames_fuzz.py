"""CAN decoders accept exactly the frames that an independent judge accepts, with their values."""

from __future__ import annotations

import struct
from math import sqrt

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from independent_frame_decoder import (
    CHANGES,
    CYCLES,
    can_sealed,
    can_values,
    can_values_right,
    changed,
    crc8,
    equal,
)

from levid.wire.can.can_frames import Fields, ValueFrames, load_frames
from levid.wire.frame_rejection_reasons import Rejected

CLASSIC, FD = load_frames(None, 9, 9, False), load_frames(None, 9, 9, True)
GROUPS = [
    group for frames in (CLASSIC, FD) for group in (frames.setpoint, frames.force, frames.gap)
]
FIELDS = [
    CLASSIC.sync, CLASSIC.request, CLASSIC.answer, CLASSIC.sensor_request, CLASSIC.sensor_answer,
]  # fmt: skip
LAYOUTS = {3: "<H", 7: "<BBI", 6: "<BI"}


def accepted(group: ValueFrames, sent: list[tuple[int, bytes]], cycle: int) -> np.ndarray | None:
    out = np.full(group.channels, 7.0)
    group.begin()
    if all(group.accept(i, d, cycle) is None for i, d in sent) and group.finish(out) is None:
        return out
    assert (out == 7.0).all()  # rejected frames change no value
    return None


@given(st.data(), st.sampled_from(GROUPS), st.integers(0, CYCLES - 1), st.integers(0, 15))
def test_values_are_accepted_only_if_right(
    data, group: ValueFrames, cycle: int, state: int
) -> None:
    length = group.frames[0].length
    good = group.encode(np.array(data.draw(VALUES)) * group.unit, cycle, state)
    at = data.draw(st.integers(0, len(good) - 1))
    can_id, payload = good[at]
    length_of_noise = st.one_of(st.just(length), st.integers(0, 64))
    payload = data.draw(
        st.one_of(
            CHANGES.map(lambda changes: changed(payload, changes)),
            length_of_noise.flatmap(lambda n: st.binary(min_size=n, max_size=n)),
        )
    )
    if data.draw(st.booleans()):  # the right counter: only the checksum can tell
        payload = payload[:-2] + bytes((state << 4 | cycle & 0xF,)) + payload[-1:]
    if data.draw(st.booleans()):  # the right checksum: everything else has to be checked
        payload = can_sealed(can_id, payload, cycle)
    sent = [*good[:at], (can_id, payload), *good[at + 1 :]]
    found = accepted(group, sent, cycle)
    right = all(can_values_right(i, d, cycle, length) for i, d in sent)
    assert (found is not None) == right
    if found is not None:
        assert equal(found, can_values((d for _, d in sent), group.unit)[: group.channels])


VALUES = st.lists(st.one_of(st.just(np.nan), st.floats(-40_000, 40_000)), min_size=9, max_size=9)


@given(st.sampled_from(FIELDS), st.binary(max_size=64), CHANGES, st.booleans(), st.booleans())
def test_numbers_are_accepted_only_if_right(
    fields: Fields, noise: bytes, changes, near: bool, sealed: bool
) -> None:
    size = fields.layout.size
    data = noise
    if near:
        body = (noise + bytes(size))[:size]
        data = changed(can_sealed(fields.can_id, body + b"\0"), changes)
    if sealed:
        data = can_sealed(fields.can_id, data)
    right = len(data) == size + 1 and data == can_sealed(fields.can_id, data)
    if fields.name == "Sync":
        right = right and int.from_bytes(data[:2], "little") < CYCLES
    expected = struct.unpack(LAYOUTS[size + 1], data[:-1]) if right else None
    found = fields.decode(data)
    assert (None if isinstance(found, Rejected) else found) == expected


@given(st.integers(0, 0xFFFF))
def test_sync_has_a_cycle_that_is_counted(cycle: int) -> None:
    found = CLASSIC.sync.decode(CLASSIC.sync.encode(cycle)[1])
    assert found == ((cycle,) if cycle < CYCLES else Rejected.CYCLE)


@pytest.mark.parametrize(("right_counter", "bits"), [(False, 12), (True, 8)])
def test_random_frames_pass_as_often_as_counter_and_checksum_predict(
    right_counter: bool, bits: int
) -> None:
    n, group, rng = 20_000, FD.gap, np.random.default_rng(1)
    passed = 0
    for cycle, row in enumerate(rng.integers(0, 256, (n, group.frames[0].length), np.uint8)):
        if right_counter:
            row[-2] = row[-2] & 0xF0 | cycle & 0xF
        passed += accepted(group, [(group.ids[0], row.tobytes())], cycle) is not None
    p = 2.0**-bits
    # 5 and 78 are expected; the bound is four standard deviations of a binomial.
    assert abs(passed - n * p) < 4.0 * sqrt(n * p * (1.0 - p))


def test_checksum_of_the_judge_is_the_standards() -> None:
    # AUTOSAR's own check value (Specification of CRC Routines).
    assert crc8(b"123456789") == 0xDF
