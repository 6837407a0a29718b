"""Test docs/can.md and docs/serial-protocol.md: their example frames are those of levid."""

from __future__ import annotations

import re
import struct
import zlib

import numpy as np
import pytest
from repository_folders import DOCS

from levid.wire.can.can_frames import load_frames
from levid.wire.can.crc8 import crc8
from levid.wire.device_protocol import (
    AMPLIFIER_LIMITS,
    AmplifierState,
    DeviceParameter,
    DriveState,
    Request,
    SensorState,
    response,
)
from levid.wire.serial.serial_frames import FrameContents, SerialFrames

CAN, SERIAL = ((DOCS / f"{name}.md").read_text() for name in ("can", "serial-protocol"))
READ_PROTOCOL = (Request.READ, DeviceParameter.PROTOCOL)


def payload(text: str, begin: str) -> bytes:
    """Return the bytes in the last cell of the table row that begins with `begin`."""
    (row,) = re.findall(rf"^\| {re.escape(begin)}.*\|$", text, re.M)
    return bytes.fromhex(row.split("|")[-2])


@pytest.fixture(scope="module")
def frames():
    return load_frames(None, 9, 9, fd=False)


def test_can_frames_of_the_docs(frames):
    assert frames.sync.encode(18) == (0x010, payload(CAN, "`Sync` of"))
    forces = np.array([1.0, -0.5, *np.zeros(7)])
    assert frames.setpoint.encode(forces, 18, 5)[0] == (0x020, payload(CAN, "`Setpoints` of"))
    assert frames.request.encode(*READ_PROTOCOL, 0) == (0x040, payload(CAN, "`Request`:"))
    assert frames.answer.encode(DeviceParameter.PROTOCOL, 1) == (0x041, payload(CAN, "`Answer`:"))


def test_serial_frames_of_the_docs():
    frames = SerialFrames(FrameContents(9, 9, True))
    assert frames.request(1, *READ_PROTOCOL) == payload(SERIAL, "REQUEST, sequence 1")
    assert frames.answer(1, DeviceParameter.PROTOCOL, 1) == payload(SERIAL, "its ANSWER")


def test_serial_cycle_of_the_docs():
    frames = SerialFrames(FrameContents(2, 1, True))
    beam, rotor = np.array([0.01, 0.1, 2.0]), np.array([-0.2, 0.5, -1.0])
    command = frames.cycle(18, np.array([1.0, -0.5]), beam, rotor)
    assert command == payload(SERIAL, "CYCLE 18")
    axes = np.array([[0.01, 0.1, 1.5], [0.01, 0.1, 1.25], [-0.2, 0.5, -0.25]])
    amplifiers = AmplifierState.ENABLED, np.array([0.999, -0.5])
    adc = SensorState.OK, np.array([-0.9e-3])
    readings = frames.readings(18, amplifiers, adc, (DriveState.OPERATING, 0, axes))
    assert readings == payload(SERIAL, "its READINGS")
    # Decode without levid: byte stuffing, checksum, and the fields in the order of the page.
    raw = decode_cobs(readings)
    assert zlib.crc32(raw[:-4]).to_bytes(4, "little") == raw[-4:]
    layout = "<BBH BBhh BBh BBH iff iff iff"
    version, kind, sequence, *fields = struct.unpack(layout, raw[:-4])
    assert (version, kind, sequence) == (1, 0x81, 18)
    assert fields[:7] == [1, 0, 999, -500, 0, 0, round(-0.9e-3 / 2e-3 * 65536)]
    assert fields[7:] == pytest.approx(
        [2, 0, 0, 10_000_000, 0.1, 1.5, 10_000_000, 0.1, 1.25, -2_000_000, 0.5, -0.25]
    )


def decode_cobs(line: bytes) -> bytes:
    """Decode a frame by the definition of consistent overhead byte stuffing (COBS)."""
    out, at = b"", 0
    while line[at]:
        out += line[at + 1 : at + line[at]] + b"\0"
        at += line[at]
    return out[:-1]


def test_crc_and_challenge_response_of_the_docs():
    (check,) = re.findall(r"CRC-8 of `123456789` is (0x\w+)", CAN)
    assert crc8(b"123456789") == int(check, 16)
    challenge, numbers, answer = re.findall(
        r"challenge (0x\w+), with the parameters 0, 1, 3, 4, 5 and 6 at ([\d, and]+), is answered "
        r"by\s(0x\w+)",
        SERIAL,
    )[0]
    limits = dict(zip(AMPLIFIER_LIMITS, map(int, re.findall(r"\d+", numbers)), strict=True))
    assert [int(p) for p in AMPLIFIER_LIMITS] == [0, 1, 3, 4, 5, 6]
    assert response(int(challenge, 16), limits) == int(answer, 16)
