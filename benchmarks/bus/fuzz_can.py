"""Noise into the decoders of CAN frames, and into what takes them from a kernel or a socket.

Everything is judged again by other means: the checksum a bit at a time, numbers by struct.
"""

from __future__ import annotations

import math
import socket
import struct
import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from levid.benchmarks.bus.mutations import Outcome, are, mutated
from levid.wire.can.can_frames import Fields, ValueFrames, load_frames
from levid.wire.can.kernel_frame import (
    ERROR_BUS_OFF,
    FRAME_SIZES,
    OTHER,
    BusOffError,
    ReceivedFrame,
    unpack_frame,
)
from levid.wire.can.local_bus import LocalFrames
from levid.wire.device_protocol import CYCLES
from levid.wire.frame_rejection import Rejected

_BATCH = 10_000
_LONGEST = 64
_STRIDE = 4001
"""Has no factor in common with the cycles that are counted."""
_EFF, _RTR, _ERR = 0x8000_0000, 0x4000_0000, 0x2000_0000
"""linux/can.h: flags in the ID of a frame."""


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
        cycle = _cycle(k)
        sent = group.encode(rng.uniform(-20, 20, 9), cycle, 1)
        at = int(rng.integers(3))
        can_id, good = sent[at]
        bad = mutated(good, rng)
        if resealed and bad:
            bad = bad[:-1] + bytes((crc8(struct.pack(">HH", can_id, cycle >> 4) + bad[:-1]),))
        sent[at] = can_id, bad
        taken, rightly = _tried(group, sent, cycle)
        accepted += taken
        wrong += not rightly
        for fields, length in ((frames.sync, 3), (frames.request, 7), (frames.answer, 6)):
            data = bad
            if resealed and bad:
                data = bad[:-1] + bytes((crc8(struct.pack(">H", fields.can_id) + bad[:-1]),))
            wrong += not _fields_are(fields, data, length)
        any_cycle = rng.integers(0, 256, 2, np.uint8).tobytes()
        sealed = crc8(struct.pack(">H", frames.sync.can_id) + any_cycle)
        wrong += not _fields_are(frames.sync, any_cycle + bytes((sealed,)), 3)
    # Nearly all mutations keep the length; they hit the counter now and then, and so do not pass.
    return Outcome(n, accepted, wrong, accepted / n)


def can_lengths(n: int, rng: np.random.Generator) -> Outcome:
    """Random payloads of 0 to 64 bytes to every decoder, of classic CAN and of CAN FD.

    Half of them have the right length, half of those of values the right counter. Where a reading
    takes three frames, the other two are good.
    """
    decoders: list[ValueFrames | Fields] = []
    for fd in (False, True):
        frames = load_frames(None, 9, 9, fd)
        decoders += [frames.setpoint, frames.force, frames.gap]
        decoders += [frames.sync, frames.request, frames.answer]
        decoders += [frames.sensor_request, frames.sensor_answer]
    values = np.zeros(9)
    accepted = wrong = 0
    expected = 0.0
    for k in range(n):
        decoder, cycle = decoders[k % len(decoders)], _cycle(k)
        of_values = isinstance(decoder, ValueFrames)
        right = decoder.frames[0].length if of_values else decoder.length
        length = right if rng.random() < 0.5 else int(rng.integers(_LONGEST + 1))
        data = bytearray(rng.integers(0, 256, length, np.uint8).tobytes())
        if not of_values:
            taken = not isinstance(decoder.decode(bytes(data)), Rejected)
            rightly = _fields_are(decoder, bytes(data), right)
            share = 2.0**-8 * (CYCLES / 2**16 if decoder.name == "Sync" else 1.0)
        else:
            share = 2.0**-12
            if length > 1 and rng.random() < 0.5:
                data[-2] = data[-2] & 0xF0 | cycle & 0x0F
                share = 2.0**-8
            sent = decoder.encode(values, cycle, 1)
            at = int(rng.integers(len(sent)))
            sent[at] = sent[at][0], bytes(data)
            taken, rightly = _tried(decoder, sent, cycle)
        accepted += taken
        wrong += not rightly
        expected += share * (length == right)
    return Outcome(n, accepted, wrong, expected / n)


def frames_unpacked(n: int, rng: np.random.Generator) -> Outcome:
    """Noise where the kernel lays out a frame, both sizes; flags of its ID in half of them."""
    accepted = wrong = 0
    for k in range(n):
        raw = _raw(rng, FRAME_SIZES[k % 2])
        found = _unpacked(raw)
        accepted += isinstance(found, ReceivedFrame) and found.can_id >= 0
        wrong += found != _laid_out(raw)
    return Outcome(n, accepted, wrong, accepted / n)


def local_bus(n: int, rng: np.random.Generator) -> Outcome:
    """Messages of 1 to 80 bytes from another process on a local bus, of CAN FD and classic."""
    accepted = wrong = 0
    with tempfile.TemporaryDirectory() as folder:
        for fd in (False, True):
            bus = LocalFrames(Path(folder) / f"{fd}", fd)
            (path,) = (Path(folder) / f"{fd}").glob("*.can")
            with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as other:
                other.connect(str(path))
                bus.receive(1.0)  # takes it in
                for k in range(n // 2):
                    size = int(rng.integers(1, 80)) if k % 4 == 0 else FRAME_SIZES[k % 2]
                    raw = _raw(rng, max(size, 6))[:size]
                    other.send(raw)
                    try:
                        found: ReceivedFrame | None = bus.receive(1.0)
                    except BusOffError:
                        found = None
                    right = _laid_out(raw) if size in FRAME_SIZES else OTHER
                    if right is not None and len(right.data) > 8 and not fd:
                        right = OTHER
                    accepted += found is not None and found.can_id >= 0
                    # When it came the kernel says.
                    wrong += (found and found[:2]) != (right and right[:2])
            bus.shutdown()
    return Outcome(n, accepted, wrong, accepted / n)


def _raw(rng: np.random.Generator, size: int) -> bytes:
    raw = bytearray(rng.integers(0, 256, size, np.uint8).tobytes())
    if rng.random() < 0.5:
        raw[0:4] = struct.pack("=I", int(rng.integers(0x800)))
    if rng.random() < 0.5:
        raw[4] = int(rng.integers(65))
    return bytes(raw)


def _unpacked(raw: bytes) -> ReceivedFrame | None:
    """Return what was made of it, None for a controller that has left the bus."""
    try:
        return unpack_frame(raw, 0.0)
    except BusOffError:
        return None


def _laid_out(raw: bytes) -> ReceivedFrame | None:
    """Return the same by linux/can.h; what claims more data than there is room for is no frame."""
    can_id = int.from_bytes(raw[:4], "little")
    if can_id & _ERR and can_id & ERROR_BUS_OFF:
        return None
    if can_id & (_EFF | _RTR | _ERR):
        return OTHER
    return ReceivedFrame(can_id, raw[8 : 8 + raw[4]], 0.0) if raw[4] <= len(raw) - 8 else OTHER


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
    right = len(data) == length and data[-1] == crc8(struct.pack(">H", fields.can_id) + data[:-1])
    if fields.name == "Sync":
        right = right and int.from_bytes(data[:2], "little") < CYCLES
    if isinstance(numbers, Rejected):
        return not right
    layout = {3: "<H", 7: "<BBI", 6: "<BI"}[length]
    return right and numbers == struct.unpack(layout, data[:-1])


def _payloads(n: int, length: int, rng: np.random.Generator) -> Iterator[tuple[bytearray, int]]:
    for begin in range(0, n, _BATCH):
        batch = rng.integers(0, 256, (min(_BATCH, n - begin), length), np.uint8)
        for k, row in enumerate(batch):
            yield bytearray(row.tobytes()), _cycle(begin + k)


def _cycle(k: int) -> int:
    """Return a number of a cycle: each there is comes once in so many."""
    return k * _STRIDE % CYCLES


def crc8(data: bytes) -> int:
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
    return data[-1] == crc8(struct.pack(">HH", can_id, cycle >> 4) + data[:-1])


def _can_values_are(out: np.ndarray, payloads: list[bytes], unit: float) -> bool:
    counts = [c for data in payloads for c in struct.unpack(f"<{len(data) // 2 - 1}h", data[:-2])]
    told = [c * unit if c != -(2**15) else math.nan for c in counts]
    return are(out, told[: len(out)], 2**15 * unit)
