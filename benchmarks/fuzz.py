"""A million random and mutated frames and bytes into each decoder: what passes, and what it costs.

Everything is judged again by other means: what a decoder accepts, what numbers it makes of it, and
what it refuses; with the right checksum too, so that all else has to be checked. Of random frames,
those pass that the width of counter and checksum predict; `z` is how far the count is from that, in
standard deviations.
"""

from __future__ import annotations

import math
import struct

import _table
import numpy as np
from _fuzz_drives import drives_heard, nodes_told
from _fuzz_serial import serial_blocks, serial_resealed, stream_of_noise
from _mutations import Outcome, are, mutated
from _table import Figure

from levid.wire.can_frames import Fields, ValueFrames, load_frames
from levid.wire.rejected import Rejected

_BATCH = 10_000


def can_random(n: int, rng: np.random.Generator, *, right_counter: bool) -> Outcome:
    """Random CAN FD payloads of the right length; with the right counter, or one drawn too."""
    group = load_frames(None, 9, 9, True).gap
    (frame,) = group.frames
    accepted = wrong = 0
    for data, cycle in _payloads(n, frame.length, rng):
        if right_counter:
            data[-2] = data[-2] & 0xF0 | cycle & 0x0F
        taken, rightly = _tried(group, [(frame.can_id, bytes(data))], cycle)
        accepted += taken
        wrong += not rightly
    return Outcome(n, accepted, wrong, 2.0**-8 if right_counter else 2.0**-12)


def can_mutated(n: int, rng: np.random.Generator, *, resealed: bool = False) -> Outcome:
    """Good classic frames of which bytes were changed, cut off or added; three make a reading.

    `resealed`: they get their checksum after that, so that what else is checked has to do.
    """
    frames = load_frames(None, 9, 9, False)
    group = frames.force
    accepted = wrong = 0
    for k in range(n):
        cycle = k & 0xFF
        sent = group.encode(rng.uniform(-20, 20, 9), cycle, 1)
        at = int(rng.integers(3))
        can_id, good = sent[at]
        bad = mutated(good, rng)
        if resealed and bad:
            bad = bad[:-1] + bytes((_crc8(struct.pack(">HH", can_id, cycle >> 4) + bad[:-1]),))
        sent[at] = can_id, bad
        taken, rightly = _tried(group, sent, cycle)
        accepted += taken
        wrong += not rightly
        for fields, length in ((frames.sync, 3), (frames.request, 7), (frames.answer, 6)):
            data = bad
            if resealed and bad:
                data = bad[:-1] + bytes((_crc8(struct.pack(">H", fields.can_id) + bad[:-1]),))
            wrong += not _fields_are(fields, data, length)
    # Nearly all mutations keep the length; they hit the counter now and then, and so do not pass.
    return Outcome(n, accepted, wrong, accepted / n)


def _tried(group: ValueFrames, sent: list[tuple[int, bytes]], cycle: int) -> tuple[bool, bool]:
    """Return whether the frames of a cycle are accepted, and whether that and all values are so."""
    out = np.zeros(group.channels)
    group.begin()
    taken = all(group.accept(i, d, cycle) is None for i, d in sent) and group.finish(out) is None
    length = group.frames[0].length
    right = all(_can_is_right(i, d, cycle, length) for i, d in sent)
    rightly = taken == right and (
        not taken or _can_values_are(out, [d for _, d in sent], group.unit)
    )
    return taken, rightly


def _fields_are(fields: Fields, data: bytes, length: int) -> bool:
    numbers = fields.decode(data)
    right = len(data) == length and data[-1] == _crc8(struct.pack(">H", fields.can_id) + data[:-1])
    if isinstance(numbers, Rejected):
        return not right
    layout = {3: "<H", 7: "<BBI", 6: "<BI"}[length]
    return right and numbers == struct.unpack(layout, data[:-1])


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
        "can_resealed": (
            can_mutated(n, rng, resealed=True),
            "mutated CAN frames, right checksum",
        ),
        "serial": (serial_blocks(n, rng), "random and mutated serial blocks"),
        "serial_resealed": (serial_resealed(n, rng), "mutated serial frames, right checksum"),
        "stream": (stream_of_noise(n, rng), "stretches of noise between serial frames"),
        "drives": (drives_heard(n, rng), "frames of CANopen drives, random and near the right"),
        "nodes": (nodes_told(n // 10, rng), "frames to emulated CANopen drives"),
    }
    figures = []
    for key, (outcome, label) in runs.items():
        share = outcome.accepted / outcome.tried
        figures += [
            Figure(f"{key}_accepted", share, "", f"{label}: share accepted"),
            Figure(f"{key}_wrong", outcome.wrong, "", f"{label}: judged wrongly, or lost"),
        ]
        if 0.0 < outcome.expected_share < 1.0 and key in ("can_random", "can_counter"):
            figures.append(Figure(f"{key}_z", outcome.z, "sd", f"{label}: off the prediction by"))
    return figures


def _payloads(n: int, length: int, rng: np.random.Generator):  # type: ignore[no-untyped-def]
    for begin in range(0, n, _BATCH):
        batch = rng.integers(0, 256, (min(_BATCH, n - begin), length), np.uint8)
        for k, row in enumerate(batch):
            yield bytearray(row.tobytes()), k & 0xFF


def _crc8(data: bytes) -> int:
    """Return CRC-8/AUTOSAR, a bit at a time: polynomial 0x2F, initial value and final xor 0xFF."""
    crc = 0xFF
    for byte in data:
        for bit in range(7, -1, -1):
            carry = (crc >> 7) ^ (byte >> bit & 1)
            crc = crc << 1 & 0xFF ^ (0x2F if carry else 0)
    return crc ^ 0xFF


def _can_is_right(can_id: int, data: bytes, cycle: int, length: int) -> bool:
    if len(data) != length or (data[-2] ^ cycle) & 0xF:
        return False
    return data[-1] == _crc8(struct.pack(">HH", can_id, cycle >> 4) + data[:-1])


def _can_values_are(out: np.ndarray, payloads: list[bytes], unit: float) -> bool:
    counts = [c for data in payloads for c in struct.unpack(f"<{len(data) // 2 - 1}h", data[:-2])]
    told = [c * unit if c != -(2**15) else math.nan for c in counts]
    return are(out, told[: len(out)], 2**15 * unit)


if __name__ == "__main__":
    _table.run("Decoders against noise", measure)
