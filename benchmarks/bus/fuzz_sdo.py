"""Noise as answers of a drive to what the host asks between cycles, by SDO.

An object is read with answers that are random, near the right one, or right, in one frame or in
segments. What comes of it must be the number that CiA 301 finds in them, or a DriverError.
"""

from __future__ import annotations

import logging
import struct
from collections.abc import Callable

import numpy as np

from levid.benchmarks.bus.mutations import Outcome, mutated
from levid.config.buses import CanBus
from levid.drivers.base import DriverError
from levid.drivers.can.bus_link import CanLink
from levid.drivers.can.canopen_nodes import DriveNode
from levid.wire.can.cia402 import SDO_ANSWER_ID, SDO_REQUEST_ID, Object

_NODE, _BYTES = 1, 8
_OBJECTS = ((Object.ACTUAL_POSITION, "<i"), (Object.STATUSWORD, "<H"), (Object.MODE_DISPLAY, "<b"))
_ABORT = struct.pack("<BHBI", 0x80, 0, 0, 0x0800_0000)
_UPLOAD, _EXPEDITED, _SIZED, _LAST, _TOGGLE = 0x40, 0x02, 0x01, 0x01, 0x10


class _Drive:
    """A bus on which every request gets the next answer at once; and none an abort."""

    def __init__(self) -> None:
        self.answers: list[bytes] = []
        self.listener: Callable[[int, bytes], None] = lambda _, __: None

    def send(self, can_id: int, data: bytes) -> None:
        if can_id == SDO_REQUEST_ID + _NODE and data[0] != _ABORT[0]:
            answer = self.answers.pop(0) if self.answers else _ABORT
            self.listener(SDO_ANSWER_ID + _NODE, answer)

    def shutdown(self) -> None:
        return


def sdo_answers(n: int, rng: np.random.Generator) -> Outcome:
    """Read an object `n` times, with answers of 0 to 64 bytes."""
    link, drive = CanLink("noise", CanBus(interface="virtual", channel="noise")), _Drive()
    link._bus = drive  # type: ignore[assignment]
    node = DriveNode("x1", _NODE, None, link)
    logging.getLogger("canopen").setLevel(logging.CRITICAL)  # it logs every answer that is wrong
    node._node.sdo.RESPONSE_TIMEOUT = 0.0  # what comes is there at once
    drive.listener = link._listeners[SDO_ANSWER_ID + _NODE]
    node.listen(True)
    accepted = wrong = 0
    for k in range(n):
        index, layout = _OBJECTS[k % len(_OBJECTS)]
        answers = _answers(index, layout, rng)
        drive.answers = list(answers)
        try:
            found: int | None = node._read(index)
        except DriverError:
            found = None
        accepted += found is not None
        wrong += found != _meant(answers, index, layout)
    return Outcome(n, accepted, wrong, accepted / n)


def _answers(index: int, layout: str, rng: np.random.Generator) -> list[bytes]:
    """Return what a drive would answer, in most cases one of its frames changed."""
    size = struct.calcsize(layout)
    value = rng.integers(0, 256, size, np.uint8).tobytes()
    if rng.random() < 0.5:
        command = _UPLOAD | _EXPEDITED | _SIZED | (4 - size) << 2
        answers = [struct.pack("<BHB4s", command, index, 0, value)]
    else:
        answers = [struct.pack("<BHBI", _UPLOAD | _SIZED, index, 0, size)]
        parts = [value] if rng.random() < 0.5 else [value[:1], value[1:]]
        for i, part in enumerate(parts):
            command = (i % 2) * _TOGGLE | (7 - len(part)) << 1 | (i + 1 == len(parts)) * _LAST
            answers.append(struct.pack("<B7s", command, part))
    at = int(rng.integers(len(answers)))
    match int(rng.integers(5)):
        case 0:
            length = 8 if rng.random() < 0.5 else int(rng.integers(65))
            answers[at] = rng.integers(0, 256, length, np.uint8).tobytes()
        case 1:
            answers[at] = mutated(answers[at], rng)
        case 2:  # one bit of the command, of which most mean something
            answers[at] = bytes((answers[at][0] ^ 1 << int(rng.integers(8)),)) + answers[at][1:]
    return answers


def _meant(answers: list[bytes], index: int, layout: str) -> int | None:
    """Return the number that these answers carry, None where they carry none."""
    first, *segments = answers
    if (
        len(first) != _BYTES
        or first[0] & 0xE0 != _UPLOAD
        or first[1:4] != struct.pack("<HB", index, 0)
    ):
        return None
    size = struct.calcsize(layout)
    told: int | None = None
    if first[0] & _EXPEDITED:
        told = 4 - (first[0] >> 2 & 3) if first[0] & _SIZED else None
        data = first[4:8][:told]
    else:
        if first[0] & _SIZED:
            (told,) = struct.unpack_from("<I", first, 4)
        joined = _joined(segments)
        if joined is None:
            return None
        data = joined
    if told is None or told > size:  # drives may send a longer word than the object has
        data = data[:size]
    return int(struct.unpack(layout, data)[0]) if len(data) == size else None


def _joined(segments: list[bytes]) -> bytes | None:
    """Return what segments carry, None where they are out of order or do not come to an end."""
    data = b""
    for i, segment in enumerate(segments):
        if len(segment) != _BYTES or segment[0] & 0xF0 != (i % 2) * _TOGGLE:
            return None
        part = segment[1 : 8 - (segment[0] >> 1 & 7)]
        data += part
        if segment[0] & _LAST or not part:
            return data
    return None
