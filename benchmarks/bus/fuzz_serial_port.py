"""Noise into the host's end of a serial port: which frame it takes for the answer to its cycle."""

from __future__ import annotations

import struct
import zlib
from itertools import pairwise
from types import SimpleNamespace

import numpy as np

from levid.benchmarks.bus.fuzz_serial import CONTENTS, LENGTHS, good_frame, readings_are, unstuffed
from levid.benchmarks.bus.mutations import Outcome, mutated
from levid.config.buses import SerialBus
from levid.drivers.bus_backend import AnswerTime
from levid.drivers.serial.transaction import TransactionPort
from levid.drivers.stale_readings import Watch
from levid.wire.device_protocol import CYCLES
from levid.wire.serial.serial_frames import Kind, SerialFrames

_PATIENT = 1 << 30


class _Line:
    """Brings the chunks it is given, one a read, and keeps what was read."""

    def __init__(self) -> None:
        self.coming: list[bytes] = []
        self.read_bytes = b""

    def open(self) -> None: ...

    def write(self, data: bytes) -> None: ...

    def read(self, _deadline_s: float) -> bytes:
        data = self.coming.pop(0) if self.coming else b""
        self.read_bytes += data
        return data


class _Heard:
    """The frames in a stream of bytes, by other means than levid's."""

    def __init__(self, longest: int) -> None:
        self._longest, self._rest = longest, b""

    def take(self, data: bytes) -> list[tuple[int, int, bytes]]:
        """Return kind, sequence number and body of what is complete and right."""
        *blocks, self._rest = (self._rest + data).split(b"\0")
        found = []
        for block in blocks:
            raw = unstuffed(block) if len(block) <= self._longest else b""
            whole = len(raw) >= 8 and zlib.crc32(raw[:-4]) == int.from_bytes(raw[-4:], "little")
            if whole and raw[0] == 1 and LENGTHS.get(raw[1]) == len(raw) - 8:
                found.append((raw[1], raw[2] | raw[3] << 8, raw[4:-4]))
        return found


def transactions(n: int, rng: np.random.Generator) -> Outcome:
    """Cycles whose answers come among noise, others' frames and answers of other cycles.

    `n` pieces in all, in chunks that are cut anywhere; some come after the answer. A reading must
    be taken where one of the cycle came, its values must be those of the first, and answers to
    questions must all be handed on; what is left over is no part of the next cycle.
    """
    port = TransactionPort("noise", SerialBus(port="/", baud=9600), CONTENTS, AnswerTime(1e9))
    port.watch = Watch("noise", _PATIENT)
    line, device = _Line(), SerialFrames(CONTENTS)
    port._line = line  # type: ignore[assignment]
    port.open()
    told: list[tuple[int, int]] = []
    port.amplifiers = SimpleNamespace(answered=lambda *it: told.append(it))  # type: ignore[assignment]
    heard = _Heard(device.longest)
    tried = accepted = wrong = cycle = 0
    while tried < n:
        cycle = (cycle + int(rng.integers(1, 4))) % CYCLES
        pieces = [_piece(device, cycle, rng) for _ in range(int(rng.integers(1, 7)))]
        tried += len(pieces)
        told.clear()
        line.read_bytes = b""
        port.sync(cycle)
        before = heard.take(line.read_bytes)
        line.read_bytes = b""
        line.coming += _chunks(b"".join(pieces), rng)
        port.collect()
        during = heard.take(line.read_bytes)
        answers = [body for kind, _, body in before + during if kind == Kind.ANSWER]
        wrong += told != [struct.unpack("<BI", body) for body in answers]
        readings = [body for kind, number, body in during if (kind, number) == (0x81, cycle)]
        accepted += port.fresh
        wrong += port.fresh != bool(readings)
        if port.fresh and readings:
            wrong += not readings_are(port.frames, readings[0])
    return Outcome(tried, accepted, wrong, accepted / tried)


def _piece(device: SerialFrames, cycle: int, rng: np.random.Generator) -> bytes:
    """Return noise, a frame that was changed, or a good one: of this cycle, or of another."""
    kind = int(rng.integers(6))
    if kind == 0:
        return rng.integers(0, 256, int(rng.integers(1, 300)), np.uint8).tobytes()
    if kind == 1:
        return good_frame(device, tuple(Kind)[int(rng.integers(4))], cycle, rng) + b"\0"
    number = cycle - int(rng.integers(1, 20)) if kind == 2 else cycle
    frame = good_frame(device, Kind.READINGS, number % CYCLES, rng)
    return (mutated(frame, rng) if kind == 3 else frame) + b"\0"


def _chunks(data: bytes, rng: np.random.Generator) -> list[bytes]:
    """Return the data in up to four chunks, none of them empty."""
    at = sorted({0, *rng.integers(0, len(data), 3).tolist(), len(data)})
    return [data[a:b] for a, b in pairwise(at)]
