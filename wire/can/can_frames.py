"""Encode and decode the CAN frames of amplifiers and ADC by a DBC file, compiled once."""

from __future__ import annotations

import math
import re
import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from itertools import accumulate
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numba import njit

from ...config.base import ConfigError
from ...config.shipped import shipped
from ..device_protocol import CYCLES
from ..frame_rejection_reasons import Rejected
from ..int16_scaling import LARGEST, NO_VALUE, Array
from .crc8 import CRC_TABLE, FrameCrc

if TYPE_CHECKING:
    from cantools.database.can import Database, Message, Signal

COUNTER_MASK = 0xF
NUMBER = r"(\d+)"
FD_LENGTHS = (12, 16, 20, 24, 32, 48, 64)
"""Payload lengths of CAN FD above 8 bytes."""
_OLDEST = 64
_FEWEST = 4
"""Fewest signals of a frame of values: one value, counter, state and crc."""
_BYTES = [bytes((i,)) for i in range(256)]
Kind = Literal["setpoint", "force", "gap"]
UNITS: dict[Kind, str] = {"setpoint": "n", "force": "n", "gap": "m"}


class ValueFrames:
    """Frames of one quantity: all channels of a cycle, 16 bits each.

    A frame has the values of consecutive channels, little endian; a byte with the cycle counter in
    its low and a state in its high half; a checksum (see FrameCrc), which also covers the upper
    bits of the cycle. The frames of a cycle are accepted together or not at all.
    """

    def __init__(
        self, kind: Kind, frames: tuple[FrameLayout, ...], channels: int, unit: float
    ) -> None:
        self.kind, self.frames, self.channels, self.unit = kind, frames, channels, unit
        self.ids = tuple(frame.can_id for frame in frames)
        lengths = [frame.length for frame in frames]
        ends = list(accumulate(lengths))
        self._spans = [(end - n, end) for n, end in zip(lengths, ends, strict=True)]
        self._cuts = [(i, *span) for i, span in zip(self.ids, self._spans, strict=True)]
        self._per_unit = 1.0 / unit
        self._layout = np.array(
            [
                (begin, frame.first, frame.count, frame.crc.start)
                for (begin, _), frame in zip(self._spans, frames, strict=True)
            ]
        )
        self._received = bytearray(ends[-1])
        self._received_bytes = np.frombuffer(self._received, np.uint8)
        self._sent_bytes = np.zeros(ends[-1], np.uint8)
        self._place = {
            frame.can_id: (*span, frame.length, frame.crc)
            for span, frame in zip(self._spans, frames, strict=True)
        }
        self._missing = set(self.ids)
        self._cycle = 0
        values = np.zeros(channels)  # compile before the first cycle
        self.encode(values, 0, 0)
        self.finish(values)

    @property
    def states(self) -> tuple[int, ...]:
        """State in each of the last received frames."""
        received = self._received
        return tuple([received[end - 2] >> 4 for _, end in self._spans])

    @staticmethod
    def tag(data: bytes) -> int:
        """Return the bits of the state; setpoints have the number of their set there."""
        return data[-2] >> 4 if len(data) > 1 else 0

    def encode(self, values: Array, cycle: int, state: int) -> list[tuple[int, bytes]]:
        """Return (ID, payload) of every frame of `cycle`, which is below CYCLES.

        Values (C,) that are not finite are sent as NO_VALUE.
        """
        tag = (cycle & COUNTER_MASK) | (state << 4)
        _pack(values, self._per_unit, cycle >> 4, tag, self._layout, self._sent_bytes)
        raw = self._sent_bytes.tobytes()
        return [(can_id, raw[begin:end]) for can_id, begin, end in self._cuts]

    def begin(self) -> None:
        """Begin a cycle: no frame of it has been received."""
        self._missing.update(self.ids)

    @property
    def begun(self) -> bool:
        """Whether any frame of the cycle has been received."""
        return len(self._missing) < len(self.ids)

    @property
    def complete(self) -> bool:
        """Whether every frame of the cycle has been received."""
        return not self._missing

    def accept(self, can_id: int, data: bytes, cycle: int) -> Rejected | None:
        """Store a received frame of this cycle; return the reason if it is rejected, else None.

        `finish` checks the checksums; here they only determine the reason of a rejection.
        """
        begin, end, length, crc = self._place[can_id]
        if len(data) != length:
            return Rejected.LENGTH
        if (data[-2] ^ cycle) & COUNTER_MASK:
            return Rejected.COUNTER if self.age(can_id, data, cycle) else Rejected.CHECKSUM
        if can_id not in self._missing:
            return Rejected.REPEATED if crc.of(data, cycle) == data[-1] else Rejected.CHECKSUM
        self._missing.discard(can_id)
        self._cycle = cycle
        self._received[begin:end] = data
        return None

    def finish(self, out: Array) -> Rejected | None:
        """Check the checksums of a complete cycle and fill `out` (C,), nan for NO_VALUE.

        Returns the reason if the cycle is rejected, with `out` unchanged, else None.
        """
        if _unpack(self._received_bytes, self._cycle >> 4, self._layout, self.unit, out):
            return None
        return Rejected.CHECKSUM

    @property
    def behind(self) -> int:
        """Age in cycles of a complete reading whose checksum failed; 0 if unknown."""
        parts = [bytes(self._received[begin:end]) for begin, end in self._spans]
        return min(self.age(i, p, self._cycle) for i, p in zip(self.ids, parts, strict=True))

    def age(self, can_id: int, data: bytes, cycle: int) -> int:
        """Return the age of a frame in cycles, by its counter and checksum.

        0 if it is of this cycle, older than 64 cycles, or corrupt.
        """
        crc = self._place[can_id][3]
        behind = (cycle - data[-2]) & COUNTER_MASK
        for age in range(behind, _OLDEST, COUNTER_MASK + 1):
            if crc.of(data, (cycle - age) % CYCLES) == data[-1]:
                return age
        return 0


@dataclass(frozen=True)
class FrameLayout:
    """One CAN frame of a ValueFrames: `count` channels from `first` on."""

    can_id: int
    name: str
    first: int
    count: int
    crc: FrameCrc = field(compare=False, repr=False)

    @property
    def length(self) -> int:
        """Length of the payload in bytes."""
        return 2 * self.count + 2


@njit(cache=True)
def _pack(values: Any, per_unit: float, high: int, tag: int, layout: Any, out: Any) -> None:
    for begin, first, count, start in layout:
        at = begin
        for i in range(first, first + count):
            counts = 0  # a frame may have room for more channels than the rig has
            if i < values.size:
                value = values[i] * per_unit
                counts = NO_VALUE
                if math.isfinite(value):
                    counts = int(min(max(np.rint(value), -LARGEST), LARGEST))
            out[at] = counts & 0xFF
            out[at + 1] = (counts >> 8) & 0xFF
            at += 2
        out[at] = tag
        crc = CRC_TABLE[CRC_TABLE[start ^ (high >> 8)] ^ (high & 0xFF)]
        for j in range(begin, at + 1):
            crc = CRC_TABLE[crc ^ out[j]]
        out[at + 1] = crc ^ 0xFF


@njit(cache=True)
def _unpack(data: Any, high: int, layout: Any, unit: float, values: Any) -> bool:
    for begin, _, count, start in layout:
        end = begin + 2 * count + 1
        crc = CRC_TABLE[CRC_TABLE[start ^ (high >> 8)] ^ (high & 0xFF)]
        for j in range(begin, end):
            crc = CRC_TABLE[crc ^ data[j]]
        if crc ^ 0xFF != data[end]:
            return False
    for begin, first, count, _ in layout:
        for i in range(count):
            if first + i >= values.size:
                break
            low, high = data[begin + 2 * i], data[begin + 2 * i + 1]
            counts = np.int16(np.uint16(low) | np.uint16(high) << 8)
            values[first + i] = counts * unit if counts != NO_VALUE else np.nan
    return True


@dataclass(frozen=True)
class Fields:
    """A frame of integers, such as Sync or Request, and their layout."""

    can_id: int
    name: str
    layout: struct.Struct
    crc: FrameCrc = field(compare=False, repr=False)
    below: int = 1 << 32
    """Upper bound of the first number, exclusive."""

    @property
    def length(self) -> int:
        """Length of the payload in bytes, checksum included."""
        return self.layout.size + 1

    def encode(self, *numbers: int) -> tuple[int, bytes]:
        """Return (ID, payload) with these numbers, in the order of the DBC's bits."""
        body = self.layout.pack(*numbers)
        return self.can_id, body + _BYTES[self.crc.of(body)]

    def decode(self, data: bytes) -> tuple[int, ...] | Rejected:
        """Return the numbers, or the reason if the frame is rejected."""
        if len(data) != self.length:
            return Rejected.LENGTH
        if self.crc.of(data) != data[-1]:
            return Rejected.CHECKSUM
        numbers = self.layout.unpack_from(data)
        return numbers if numbers[0] < self.below else Rejected.CYCLE


@dataclass(frozen=True)
class CanFrames:
    """All frames of amplifiers, ADC and host on a CAN bus.

    `sync`: cycle (16 bits). `request`: request, index, value. `answer`: index, value. Each end has
    its own instance, because ValueFrames store received frames.
    """

    sync: Fields
    request: Fields
    answer: Fields
    sensor_request: Fields
    sensor_answer: Fields
    setpoint: ValueFrames
    force: ValueFrames
    gap: ValueFrames

    def ids(self, *, amplifiers: bool, sensors: bool) -> Iterator[tuple[int, str]]:
        """Yield ID and name of every frame that these roles need."""
        fields: list[Fields | FrameLayout] = [self.sync]
        if amplifiers:
            fields += [self.request, self.answer]
            fields += [*self.setpoint.frames, *self.force.frames]
        if sensors:
            fields += [self.sensor_request, self.sensor_answer]
            fields += self.gap.frames
        for frame in fields:
            yield frame.can_id, frame.name


def load_frames(dbc: Path | None, coils: int, sensors: int, fd: bool) -> CanFrames:
    """Compile a DBC file, by default config/levid.dbc, for a number of coils and sensors.

    Messages are found by name, `Sync`, `Request`, `Answer`, `SensorRequest`, `SensorAnswer`, or by
    their signals `setpoint_I_n`, `force_I_n`, `gap_I_m`; of the latter only messages in the frame
    format `fd` (`VFrameFormat`) are used.

    Raises:
        ConfigError: a message is missing, or a signal is not at the bits that levid uses.
    """
    from cantools import database

    path = dbc or shipped("levid.dbc")
    try:
        loaded = database.load_file(str(path))
    except Exception as error:  # noqa: BLE001 - cantools raises any exception
        raise ConfigError(f"{path}: not a valid DBC: {error}") from None
    return _Compiler(path, loaded, fd).compile(coils, sensors)  # type: ignore[arg-type]


class _Compiler:
    def __init__(self, path: Path, database: Database, fd: bool) -> None:
        self._path, self._database, self._fd = path, database, fd

    def compile(self, coils: int, sensors: int) -> CanFrames:
        return CanFrames(
            self._fields("Sync", "<H", CYCLES),
            self._fields("Request", "<BBI"),
            self._fields("Answer", "<BI"),
            self._fields("SensorRequest", "<BBI"),
            self._fields("SensorAnswer", "<BI"),
            self._values("setpoint", coils),
            self._values("force", coils),
            self._values("gap", sensors),
        )

    def _fields(self, name: str, layout: str, below: int = 1 << 32) -> Fields:
        message = next((m for m in self._database.messages if m.name == name), None)
        if message is None:
            raise ConfigError(f"{self._path}: expected a message {name}, found none")
        compiled = struct.Struct(layout)
        self._check_id(message)
        if not message.signals:
            raise ConfigError(f"{self._path}: {name}: expected signals, found none")
        *numbers, crc = sorted(message.signals, key=lambda s: s.start)
        if message.length != compiled.size + 1 or len(numbers) != len(layout) - 1:
            raise ConfigError(
                f"{self._path}: {name}: expected {len(layout) - 1} numbers in {compiled.size} "
                f"bytes and a checksum, found {len(numbers)} in {message.length - 1}"
            )
        at = 0
        for signal, code in zip(numbers, layout[1:], strict=True):
            self._check(message, signal, at, 8 * struct.calcsize(f"<{code}"), signed=False)
            at += signal.length
        self._check(message, crc, at, 8, signed=False, name="crc")
        frame_id = message.frame_id
        return Fields(frame_id, name, compiled, FrameCrc(frame_id, message.length), below)

    def _values(self, kind: Kind, channels: int) -> ValueFrames:
        unit_name = UNITS[kind]
        pattern = re.compile(f"{kind}_{NUMBER}_{unit_name}")
        frames: list[FrameLayout] = []
        units: set[float] = set()
        for message in self._database.messages:
            if message.is_fd != self._fd or not any(map(_matches(pattern), message.signals)):
                continue
            frame, unit = self._frame(message, pattern)
            units.add(unit)
            if frame.first < channels:
                frames.append(frame)
        frames.sort(key=lambda frame: frame.first)
        form = "CAN FD" if self._fd else "classic CAN"
        covered = 0
        for frame in frames:
            if frame.first != covered:
                break
            covered += frame.count
        twice = sum(frame.count for frame in frames) - covered
        if covered < channels or twice > 0 or len(units) != 1:
            more = f", {twice} repeated or out of sequence," if twice > 0 else ""
            raise ConfigError(
                f"{self._path}: expected {form} messages with {kind}_0_{unit_name} to "
                f"{kind}_{channels - 1}_{unit_name}, each once and with one scale, found "
                f"{covered} of them{more} and {len(units)} scales"
            )
        return ValueFrames(kind, tuple(frames), channels, units.pop())

    def _frame(self, message: Message, pattern: re.Pattern[str]) -> tuple[FrameLayout, float]:
        self._check_id(message)
        if len(message.signals) < _FEWEST:
            raise ConfigError(
                f"{self._path}: {message.name}: expected at least one value, counter, state and "
                f"crc, found {', '.join(signal.name for signal in message.signals)}"
            )
        *values, counter, state, crc = sorted(message.signals, key=lambda s: s.start)
        numbers = []
        for i, signal in enumerate(values):
            found = pattern.fullmatch(signal.name)
            if found is None:
                raise ConfigError(
                    f"{self._path}: {message.name}.{signal.name}: expected a name like "
                    f"{pattern.pattern.replace(NUMBER, '0')}"
                )
            numbers.append(int(found[1]))
            self._check(message, signal, 16 * i, 16, signed=True)
        if numbers != list(range(numbers[0], numbers[0] + len(numbers))):
            raise ConfigError(
                f"{self._path}: {message.name}: expected consecutive channels, found {numbers}"
            )
        scales = {float(signal.scale) for signal in values}
        if len(scales) != 1 or any(signal.offset for signal in values):
            raise ConfigError(
                f"{self._path}: {message.name}: expected one scale and no offset, found "
                f"{sorted(scales)}"
            )
        scale = scales.pop()
        if not (math.isfinite(1.0 / scale if scale > 0.0 else math.inf) and scale < math.inf):
            raise ConfigError(
                f"{self._path}: {message.name}: expected a scale above 0, found {scale:g}"
            )
        at = 16 * len(values)
        self._check(message, counter, at, 4, signed=False, name="counter")
        self._check(message, state, at + 4, 4, signed=False, name="state")
        self._check(message, crc, at + 8, 8, signed=False, name="crc")
        length = 2 * len(values) + 2
        if message.length != length:
            raise ConfigError(
                f"{self._path}: {message.name}: expected {length} bytes, found {message.length}"
            )
        lengths = (*range(9), *FD_LENGTHS) if self._fd else range(9)
        if length not in lengths:
            raise ConfigError(
                f"{self._path}: {message.name}: expected at most 8 bytes, or in CAN FD one of "
                f"{', '.join(map(str, FD_LENGTHS))}, found {length}"
            )
        crc_of = FrameCrc(message.frame_id, length)
        frame = FrameLayout(message.frame_id, message.name, numbers[0], len(numbers), crc_of)
        return frame, scale

    def _check_id(self, message: Message) -> None:
        if message.is_extended_frame:
            raise ConfigError(
                f"{self._path}: {message.name}: expected an 11-bit ID, found the 29-bit ID "
                f"0x{message.frame_id:x}"
            )

    def _check(
        self,
        message: Message,
        signal: Signal,
        start: int,
        length: int,
        *,
        signed: bool,
        name: str | None = None,
    ) -> None:
        found = (signal.start, signal.length, signal.is_signed, signal.byte_order)
        if (
            found != (start, length, signed, "little_endian")
            or (name or signal.name) != signal.name
        ):
            raise ConfigError(
                f"{self._path}: {message.name}.{signal.name}: expected {name or 'a number'} at bit "
                f"{start}, {length} bits, {'signed' if signed else 'unsigned'}, little endian; "
                f"found {signal.length} bits at bit {signal.start}, "
                f"{'signed' if signal.is_signed else 'unsigned'}, {signal.byte_order}"
            )


def _matches(pattern: re.Pattern[str]) -> Callable[[Signal], bool]:
    return lambda signal: pattern.fullmatch(signal.name) is not None
