"""An object that is read by SDO is the number that CiA 301 finds in the answers, or an error."""

from __future__ import annotations

import logging
import struct
from collections.abc import Callable

from hypothesis import given
from hypothesis import strategies as st
from independent_frame_decoder import CHANGES, changed

from levid.config.buses import CanBus
from levid.drivers.base import DriverError
from levid.drivers.can.bus_link import CanLink
from levid.drivers.can.canopen_homing_and_enabling import DriveNode

NODE, BYTES = 1, 8
REQUEST_ID, ANSWER_ID = 0x600 + NODE, 0x580 + NODE
LAYOUTS = {0x6064: "<i", 0x6041: "<H", 0x6061: "<b"}
"""Actual position, statusword and mode display of CiA 402."""
ABORT = struct.pack("<BHBI", 0x80, 0, 0, 0x0800_0000)
UPLOAD, EXPEDITED, SIZED, LAST, TOGGLE = 0x40, 0x02, 0x01, 0x01, 0x10


class Drive:
    """A bus on which every request gets the next answer at once, and an abort after the last."""

    def __init__(self) -> None:
        self.answers: list[bytes] = []
        self.listener: Callable[[int, bytes], None] = lambda _, __: None

    def send(self, can_id: int, data: bytes) -> None:
        if can_id == REQUEST_ID and data[0] != ABORT[0]:
            self.listener(ANSWER_ID, self.answers.pop(0) if self.answers else ABORT)


def node_at(drive: Drive) -> DriveNode:
    link = CanLink("noise", CanBus(interface="virtual", channel="noise"))
    link._bus = drive
    node = DriveNode("x1", NODE, None, link)
    logging.getLogger("canopen").setLevel(logging.CRITICAL)  # it logs every wrong answer
    node._node.sdo.RESPONSE_TIMEOUT = 0.0  # an answer is there at once, or never
    drive.listener = link._listeners[ANSWER_ID]
    node.listen(True)
    return node


DRIVE = Drive()
X1 = node_at(DRIVE)


@st.composite
def exchanges(draw) -> tuple[int, list[bytes]]:
    """Draw an object and the answers of a drive, in one frame or in segments; one may be wrong."""
    index = draw(st.sampled_from(sorted(LAYOUTS)))
    size = struct.calcsize(LAYOUTS[index])
    value = draw(st.binary(min_size=size, max_size=size))
    if draw(st.booleans()):
        command = UPLOAD | EXPEDITED | SIZED | (4 - size) << 2
        answers = [struct.pack("<BHB4s", command, index, 0, value)]
    else:
        answers = [struct.pack("<BHBI", UPLOAD | SIZED, index, 0, size)]
        parts = [value] if draw(st.booleans()) else [value[:1], value[1:]]
        for i, part in enumerate(parts):
            command = (i % 2) * TOGGLE | (7 - len(part)) << 1 | (i + 1 == len(parts)) * LAST
            answers.append(struct.pack("<B7s", command, part))
    at = draw(st.integers(0, len(answers) - 1))
    wrong = st.one_of(
        st.just(answers[at]),
        st.binary(min_size=BYTES, max_size=BYTES),
        st.binary(max_size=64),
        CHANGES.map(lambda changes: changed(answers[at], changes)),
        st.integers(0, 7).map(lambda bit: bytes((answers[at][0] ^ 1 << bit,)) + answers[at][1:]),
    )
    answers[at] = draw(wrong)
    return index, answers


@given(exchanges())
def test_object_is_the_number_of_the_standard_or_an_error(
    exchange: tuple[int, list[bytes]],
) -> None:
    index, answers = exchange
    DRIVE.answers = list(answers)
    try:
        found: int | None = X1._read(index)
    except DriverError:
        found = None
    assert found == number_in(answers, index, LAYOUTS[index])


def number_in(answers: list[bytes], index: int, layout: str) -> int | None:
    """Return the number that these answers carry, None if they carry none."""
    first, *segments = answers
    right = len(first) == BYTES and first[0] & 0xE0 == UPLOAD
    if not right or first[1:4] != struct.pack("<HB", index, 0):
        return None
    size = struct.calcsize(layout)
    announced: int | None = None
    if first[0] & EXPEDITED:
        announced = 4 - (first[0] >> 2 & 3) if first[0] & SIZED else None
        data: bytes | None = first[4:8][:announced]
    else:
        if first[0] & SIZED:
            (announced,) = struct.unpack_from("<I", first, 4)
        data = joined(segments)
    if data is None:
        return None
    if announced is None or announced > size:  # drives may send a longer word than the object has
        data = data[:size]
    return int(struct.unpack(layout, data)[0]) if len(data) == size else None


def joined(segments: list[bytes]) -> bytes | None:
    """Return the data of segments, None if they are out of order or have no end."""
    data = b""
    for i, segment in enumerate(segments):
        if len(segment) != BYTES or segment[0] & 0xF0 != (i % 2) * TOGGLE:
            return None
        part = segment[1 : 8 - (segment[0] >> 1 & 7)]
        data += part
        if segment[0] & LAST or not part:
            return data
    return None
