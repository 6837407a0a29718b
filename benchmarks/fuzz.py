"""A million random and mutated frames and bytes into each decoder: what passes, and what it costs.

Everything that a decoder accepts is checked again by other means. Of random frames, those pass that
the width of counter and checksum predict; `z` is how far the count is from that, in standard
deviations.
"""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass
from math import sqrt

import _table
import numpy as np
from _table import Figure

from levid.wire.can_frames import load_frames
from levid.wire.rejected import Rejected
from levid.wire.serial_frames import Contents, Header, SerialFrames
from levid.wire.stream import FrameStream

_BATCH = 10_000


@dataclass(frozen=True)
class Outcome:
    """Frames tried, accepted, accepted though they should not be, and the share to be expected."""

    tried: int
    accepted: int
    wrong: int
    expected_share: float

    @property
    def z(self) -> float:
        """Distance of the accepted from the expected, in standard deviations of a binomial."""
        p = self.expected_share
        spread = sqrt(self.tried * p * (1.0 - p))
        return (self.accepted - self.tried * p) / spread if spread else float(self.accepted)


def can_random(n: int, rng: np.random.Generator, *, right_counter: bool) -> Outcome:
    """Random CAN FD payloads of the right length; with the right counter, or one drawn too."""
    group = load_frames(None, 9, 9, True).gap
    (frame,) = group.frames
    out = np.zeros(9)
    accepted = wrong = 0
    for data, cycle in _payloads(n, frame.length, rng):
        if right_counter:
            data[-2] = data[-2] & 0xF0 | cycle & 0x0F
        payload = bytes(data)
        group.begin()
        if group.accept(frame.can_id, payload, cycle) is None and group.finish(out) is None:
            accepted += 1
            wrong += not _can_is_right(frame.can_id, payload, cycle)
    return Outcome(n, accepted, wrong, 2.0**-8 if right_counter else 2.0**-12)


def can_mutated(n: int, rng: np.random.Generator) -> Outcome:
    """Good classic frames of which bytes were changed, cut off or added; three make a reading."""
    frames = load_frames(None, 9, 9, False)
    group, out = frames.force, np.zeros(9)
    accepted = wrong = 0
    for k in range(n):
        cycle = k & 0xFF
        sent = group.encode(rng.uniform(-20, 20, 9), cycle, 1)
        at = int(rng.integers(3))
        can_id, good = sent[at]
        bad = _mutated(good, rng)
        sent[at] = can_id, bad
        group.begin()
        if all(group.accept(i, d, cycle) is None for i, d in sent) and group.finish(out) is None:
            accepted += 1
            wrong += not all(_can_is_right(i, d, cycle) for i, d in sent)
        for fields in (frames.sync, frames.request, frames.answer):
            numbers = fields.decode(bad)
            wrong += (
                not isinstance(numbers, Rejected)
                and _crc8(struct.pack(">H", fields.can_id) + bad[:-1]) != bad[-1]
            )
    # Nearly all mutations keep the length; they hit the counter now and then, and so do not pass.
    return Outcome(n, accepted, wrong, accepted / n)


def serial_blocks(n: int, rng: np.random.Generator) -> Outcome:
    """Random blocks, and good frames of which bytes were changed, cut off or added."""
    frames = SerialFrames(Contents(9, 9, True))
    accepted = wrong = 0
    values, pose = np.zeros(9), np.zeros(3)
    for k in range(n):
        if k % 2:
            block = rng.integers(0, 256, int(rng.integers(0, 120)), np.uint8).tobytes()
            good = b""
        else:
            values[:] = rng.uniform(-20, 20, 9)
            good = frames.cycle(k, values, pose, pose)[:-1]
            block = _mutated(good, rng)
        if isinstance(frames.accept(block), Header) and block != good:
            accepted += 1
            wrong += not _serial_is_right(block)
    return Outcome(n, accepted, wrong, 2.0**-32)


def stream_of_noise(n: int, rng: np.random.Generator) -> Outcome:
    """Bytes of noise with a good frame after each stretch: all that are whole must come out.

    The first frame after noise may be lost, as the noise runs on into it; the second may not.
    """
    frames = SerialFrames(Contents(9, 9, True))
    stream = FrameStream(frames.longest)
    lost = tried = done = 0
    values, pose = np.zeros(9), np.zeros(3)
    while done < n:
        noise = rng.integers(0, 256, int(rng.integers(1, 400)), np.uint8).tobytes()
        good = frames.cycle(tried, values, pose, pose)
        data = noise + good + good
        cut = int(rng.integers(0, len(data)))
        blocks = stream.feed(data[:cut]) + stream.feed(data[cut:])
        last = frames.accept(blocks[-1])
        lost += not (isinstance(last, Header) and last.sequence == tried & 0xFFFF)
        tried += 1
        done += len(data)
    return Outcome(tried, tried - lost, lost, 1.0)


def measure(quick: bool) -> list[Figure]:
    n = 100_000 if quick else 1_000_000
    rng = np.random.default_rng(5)
    runs = {
        "can_random": (can_random(n, rng, right_counter=False), "random CAN FD frames"),
        "can_counter": (
            can_random(n, rng, right_counter=True),
            "random CAN FD frames, right counter",
        ),
        "can_mutated": (can_mutated(n, rng), "mutated CAN frames"),
        "serial": (serial_blocks(n, rng), "random and mutated serial blocks"),
        "stream": (stream_of_noise(n, rng), "bytes of noise between serial frames"),
    }
    figures = []
    for key, (outcome, label) in runs.items():
        share = outcome.accepted / outcome.tried
        figures += [
            Figure(f"{key}_accepted", share, "", f"{label}: share accepted"),
            Figure(f"{key}_wrong", outcome.wrong, "", f"{label}: accepted wrongly, or lost"),
        ]
        if 0.0 < outcome.expected_share < 1.0 and key in ("can_random", "can_counter"):
            figures.append(Figure(f"{key}_z", outcome.z, "sd", f"{label}: off the prediction by"))
    return figures


def _payloads(n: int, length: int, rng: np.random.Generator):  # type: ignore[no-untyped-def]
    for begin in range(0, n, _BATCH):
        batch = rng.integers(0, 256, (min(_BATCH, n - begin), length), np.uint8)
        for k, row in enumerate(batch):
            yield bytearray(row.tobytes()), k & 0xFF


def _mutated(good: bytes, rng: np.random.Generator) -> bytes:
    data = bytearray(good)
    for _ in range(int(rng.integers(1, 4))):
        kind = int(rng.integers(8))
        at = int(rng.integers(max(len(data), 1)))
        if kind == 0:
            del data[at:]
        elif kind == 1:
            data[at:at] = rng.integers(0, 256, int(rng.integers(1, 5)), np.uint8).tobytes()
        elif data:
            data[at % len(data)] ^= int(rng.integers(1, 256))
    return bytes(data)


def _crc8(data: bytes) -> int:
    """Return CRC-8/AUTOSAR, a bit at a time: polynomial 0x2F, initial value and final xor 0xFF."""
    crc = 0xFF
    for byte in data:
        for bit in range(7, -1, -1):
            carry = (crc >> 7) ^ (byte >> bit & 1)
            crc = crc << 1 & 0xFF ^ (0x2F if carry else 0)
    return crc ^ 0xFF


def _can_is_right(can_id: int, data: bytes, cycle: int) -> bool:
    expected = _crc8(struct.pack(">HH", can_id, cycle >> 4) + data[:-1])
    return len(data) in (8, 20) and data[-1] == expected and (data[-2] ^ cycle) & 0xF == 0


def _serial_is_right(block: bytes) -> bool:
    raw, at = bytearray(), 0
    while at < len(block):
        code = block[at]
        raw += block[at + 1 : at + code]
        at += code
        if code < 0xFF and at < len(block):
            raw.append(0)
    return raw[0] == 1 and zlib.crc32(raw[:-4]) == struct.unpack("<I", raw[-4:])[0]


if __name__ == "__main__":
    _table.run("Decoders against noise", measure)
