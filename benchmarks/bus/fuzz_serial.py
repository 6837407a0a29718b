"""Noise into the decoders of the serial protocol, checked by other means: zlib and struct."""

from __future__ import annotations

import math
import struct
import zlib
from unittest import mock

import numpy as np

from levid.benchmarks.bus.mutations import Outcome, are, mutated
from levid.wire.device_protocol import CYCLES
from levid.wire.frame_rejection import Rejected
from levid.wire.serial import serial_frames
from levid.wire.serial.frame_splitter import FrameStream
from levid.wire.serial.serial_frames import FrameContents, Header, Kind, SerialFrames

CONTENTS = FrameContents(9, 9, True)
# docs/serial-protocol.md: length of the body of each kind
LENGTHS = {0x01: 18 + 24, 0x81: 20 + 20 + 4 + 36, 0x02: 6, 0x82: 5}
_OF_CYCLES = (0x01, 0x81)
_STRIDE = 4001
"""Odd, so that every sequence comes, those beyond the cycles that are counted too."""
_FORCE_N, _GAP_M, _BEAM_M, _ROTOR_RAD = 1e-3, 2e-3 / 65536, 1e-9, 1e-7


def serial_blocks(n: int, rng: np.random.Generator) -> Outcome:
    """Random blocks, and good frames of which bytes were changed, cut off or added."""
    frames = SerialFrames(CONTENTS)
    accepted = wrong = 0
    for k in range(n):
        good = b""
        if k % 2:
            block = rng.integers(0, 256, int(rng.integers(0, 120)), np.uint8).tobytes()
        else:
            good = good_frame(frames, Kind.CYCLE, k * _STRIDE & 0xFFFF, rng)
            block = mutated(good, rng)
        header = frames.accept(block)
        accepted += isinstance(header, Header) and block != good
        wrong += not _judged_rightly(frames, header, block)
    return Outcome(n, accepted, wrong, 2.0**-32)


def serial_resealed(n: int, rng: np.random.Generator) -> Outcome:
    """Frames of every kind that were changed before they got their checksum, which is right."""
    frames = SerialFrames(CONTENTS)
    accepted = wrong = 0
    for k in range(n):
        number = k * _STRIDE & 0xFFFF
        good = unstuffed(good_frame(frames, tuple(Kind)[k % 4], number, rng))[:-4]
        raw = bytearray(mutated(good, rng))
        if k % 3 == 0 and len(raw) > 1:  # version or kind: one of those next to the right one
            raw[k // 3 % 2] ^= 1 << int(rng.integers(8))
        if k % 5 == 0 and len(raw) > 8:  # no number, in the place of one or across two
            at = 4 + 2 * int(rng.integers((len(raw) - 6) // 2))
            raw[at : at + 4] = b"\0\0\0\x80"[: len(raw) - at]
        block = stuffed(raw + struct.pack("<I", zlib.crc32(raw)))
        header = frames.accept(block)
        accepted += isinstance(header, Header)
        wrong += not _judged_rightly(frames, header, block)
    return Outcome(n, accepted, wrong, accepted / n)


def serial_crc12(n: int, rng: np.random.Generator) -> Outcome:
    """Random bytes, rightly stuffed, against a checksum of which the low 12 bits alone count.

    Of 32 bits a million frames would show nothing: one in 4e9 passes.
    """
    frames = SerialFrames(CONTENTS)
    beyond = {Rejected.VERSION, Rejected.KIND, Rejected.LENGTH, Rejected.CYCLE}
    accepted = wrong = 0
    with mock.patch.multiple(serial_frames, zlib=_Narrow, _CRC=_Narrow):
        for _ in range(n):
            raw = rng.integers(0, 256, int(rng.integers(8, 89)), np.uint8).tobytes()
            judged = frames.accept(stuffed(raw))
            agree = (zlib.crc32(raw[:-4]) ^ int.from_bytes(raw[-4:], "little")) & 0xFFF == 0
            passed = isinstance(judged, Header) or judged in beyond
            accepted += passed
            wrong += passed != agree or judged is Rejected.FRAMING
    return Outcome(n, accepted, wrong, 2.0**-12)


class _Narrow:
    """In the place of zlib and of the checksum's struct: 12 bits of it."""

    size = 4

    @staticmethod
    def crc32(data: bytes) -> int:
        return zlib.crc32(data) & 0xFFF

    @staticmethod
    def unpack_from(raw: bytes, at: int) -> tuple[int]:
        return (int.from_bytes(raw[at : at + 4], "little") & 0xFFF,)


def stream_of_noise(n: int, rng: np.random.Generator) -> Outcome:
    """Stretches of noise with good frames after each: all that are whole must come out.

    The first frame after noise may be lost, as the noise runs on into it; the second may not.
    """
    frames = SerialFrames(CONTENTS)
    stream = FrameStream(frames.longest)
    lost = 0
    values, pose = np.zeros(9), np.zeros(3)
    for k in range(n):
        noise = rng.integers(0, 256, int(rng.integers(1, 400)), np.uint8).tobytes()
        good = frames.cycle(k % CYCLES, values, pose, pose)
        data = noise + good + good
        cut = int(rng.integers(0, len(data)))
        blocks = stream.feed(data[:cut]) + stream.feed(data[cut:])
        last = frames.accept(blocks[-1])
        lost += not (isinstance(last, Header) and last.sequence == k % CYCLES)
    return Outcome(n, n - lost, lost, 1.0)


def good_frame(frames: SerialFrames, kind: Kind, k: int, rng: np.random.Generator) -> bytes:
    """Return a frame as it should be, without its final zero."""
    values, axes = rng.uniform(-20.0, 20.0, 9), rng.uniform(-0.1, 0.1, (3, 3))
    match kind:
        case Kind.CYCLE:
            frame = frames.cycle(k, values, axes[0], axes[2])
        case Kind.READINGS:
            frame = frames.readings(k, (1, values), (0, 4e-5 * values), (2, 0, axes))
        case Kind.REQUEST:
            frame = frames.request(k, 1, k & 0xFF, k)
        case Kind.ANSWER:
            frame = frames.answer(k, k & 0xFF, k)
    return frame[:-1]


def _judged_rightly(frames: SerialFrames, header: Header | Rejected, block: bytes) -> bool:
    """Return whether a block was accepted as it should be, with what stands in it, or refused."""
    raw = unstuffed(block)
    body = raw[4:-4]
    right = (
        len(raw) >= 8
        and zlib.crc32(raw[:-4]) == struct.unpack("<I", raw[-4:])[0]
        and raw[0] == 1
        and LENGTHS.get(raw[1]) == len(body)
        and (raw[1] not in _OF_CYCLES or raw[2] | raw[3] << 8 < CYCLES)
    )
    if not isinstance(header, Header):
        return not right
    if not right or (header.kind, header.sequence) != (raw[1], raw[2] | raw[3] << 8):
        return False
    match header.kind:
        case Kind.CYCLE:
            return _setpoints_are(frames, body)
        case Kind.READINGS:
            return readings_are(frames, body)
        case Kind.REQUEST:
            return frames.request_received() == struct.unpack("<BBI", body)
        case Kind.ANSWER:
            return frames.answer_received() == struct.unpack("<BI", body)


def _setpoints_are(frames: SerialFrames, body: bytes) -> bool:
    force, motion = np.zeros(9), np.zeros((2, 3))
    frames.setpoints(force)
    frames.drive_setpoints(*motion)
    beam, rotor = struct.unpack_from("<iff", body, 18), struct.unpack_from("<iff", body, 30)
    told = [*_long(beam, _BEAM_M), *_long(rotor, _ROTOR_RAD)]
    most = [2**31 * _BEAM_M, math.inf, math.inf, 2**31 * _ROTOR_RAD, math.inf, math.inf]
    return are(force, _short(body[:18], _FORCE_N), 2**15 * _FORCE_N) and are(
        motion.ravel(), told, np.array(most)
    )


def readings_are(frames: SerialFrames, body: bytes) -> bool:
    force, gap, axes = np.zeros(9), np.zeros(9), np.zeros((3, 3))
    states = frames.amplifier_readings(force), frames.sensor_readings(gap)
    states += frames.drive_readings(axes)
    units = (_BEAM_M, _BEAM_M, _ROTOR_RAD)
    told = [
        number
        for i, unit in enumerate(units)
        for number in _long(struct.unpack_from("<iff", body, 44 + 12 * i), unit)
    ]
    most = np.array([[2**31 * unit, math.inf, math.inf] for unit in units]).ravel()
    return (
        states == (body[0], body[20], body[40], body[42] | body[43] << 8)
        and are(force, _short(body[2:20], _FORCE_N), 2**15 * _FORCE_N)
        and are(gap, _short(body[22:40], _GAP_M), 2**15 * _GAP_M)
        and are(axes.ravel(), told, most)
    )


def _short(data: bytes, unit: float) -> list[float]:
    counts = struct.unpack(f"<{len(data) // 2}h", data)
    return [c * unit if c != -(2**15) else math.nan for c in counts]


def _long(motion: tuple[int, float, float], unit: float) -> list[float]:
    """Return position, velocity and the third, nan where there is none; speeds as they came."""
    return [motion[0] * unit if motion[0] != -(2**31) else math.nan, *motion[1:]]


def unstuffed(block: bytes) -> bytes:
    """Undo COBS; empty where it is none."""
    raw, at = bytearray(), 0
    while at < len(block):
        code = block[at]
        part = block[at + 1 : at + code]
        if code == 0 or len(part) != code - 1 or 0 in part:
            return b""
        raw += part
        at += code
        if code < 0xFF and at < len(block):
            raw.append(0)
    return bytes(raw)


def stuffed(raw: bytes) -> bytes:
    """Return COBS of it, without the final zero."""
    out = bytearray()
    parts = bytes(raw).split(b"\0")
    for i, part in enumerate(parts):
        rest = part
        while len(rest) >= 254:
            out += b"\xff" + rest[:254]
            rest = rest[254:]
            if not rest and i + 1 == len(parts):
                return bytes(out)
        out += bytes((len(rest) + 1,)) + rest
    return bytes(out)
