"""Encode and decode the frames of the serial protocol.

docs/serial-protocol.md describes them byte by byte.
"""

from __future__ import annotations

import math
import struct
import zlib
from collections.abc import Collection
from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from ...config.rig import RigConfig
from ..device_protocol import CYCLES, PROTOCOL
from ..frame_rejection_reasons import Rejected
from ..int16_scaling import Array, quantise, scale
from . import cobs

FORCE_N = 1e-3
GAP_M = 2e-3 / 65536
BEAM_M = 1e-9
ROTOR_RAD = 1e-7
AXES = ("X1", "X2", "PHI")

_HEADER = struct.Struct("<BBH")
_CRC = struct.Struct("<I")
_STATE = struct.Struct("<BB")
_SETPOINTS = struct.Struct("<iffiff")
_DRIVES = struct.Struct("<BBH" + "iff" * len(AXES))
_REQUEST = struct.Struct("<BBI")
_ANSWER = struct.Struct("<BI")
_MOST = 2**31 - 1


class Kind(IntEnum):
    """Kind of a frame; frames of the device have the highest bit set."""

    CYCLE = 0x01
    REQUEST = 0x02
    READINGS = 0x81
    ANSWER = 0x82


@dataclass(frozen=True)
class FrameContents:
    """Numbers of coils and sensors on a port, and whether it has drives."""

    coils: int
    sensors: int
    drives: bool

    @classmethod
    def of(cls, rig: RigConfig, roles: Collection[str]) -> FrameContents:
        """Return the contents of a port with these roles of a rig."""
        return cls(
            len(rig.geometry.coil_x_m) if "amplifiers" in roles else 0,
            len(rig.geometry.sensors_x_m) if "sensors" in roles else 0,
            "drives" in roles,
        )

    @property
    def cycle_bytes(self) -> int:
        """Length of the body of a CYCLE frame, between header and checksum."""
        return 2 * self.coils + (_SETPOINTS.size if self.drives else 0)

    @property
    def readings_bytes(self) -> int:
        """Length of the body of a READINGS frame."""
        amplifiers = 2 * self.coils + 2 if self.coils else 0
        sensors = 2 * self.sensors + 2 if self.sensors else 0
        return amplifiers + sensors + (_DRIVES.size if self.drives else 0)

    def on_wire(self, body_bytes: int) -> int:
        """Return the largest length in bytes of an encoded frame with a body of `body_bytes`."""
        return cobs.encoded_length(_HEADER.size + body_bytes + _CRC.size)


@dataclass(frozen=True)
class Header:
    """Kind and sequence number of a frame that passed every check."""

    kind: Kind
    sequence: int


class SerialFrames:
    """Packs and unpacks the frames of one end of a port; stores the last accepted frame."""

    def __init__(self, contents: FrameContents) -> None:
        self.contents = contents
        self._lengths = {
            Kind.CYCLE: contents.cycle_bytes,
            Kind.READINGS: contents.readings_bytes,
            Kind.REQUEST: _REQUEST.size,
            Kind.ANSWER: _ANSWER.size,
        }
        longest = max(self._lengths.values()) + _HEADER.size + _CRC.size
        self._sent = _Buffer(longest, contents)
        self._received = _Buffer(longest, contents)
        self._stuffed = np.zeros(cobs.encoded_length(longest), np.uint8)
        self.longest = contents.on_wire(max(self._lengths.values()))
        """Largest length of an encoded frame in bytes, final zero included."""
        self._compile()

    def cycle(self, sequence: int, coil_n: Array, beam: Array, rotor: Array) -> bytes:
        """Return the CYCLE frame: forces (C,) in N, beam and rotor (3,) in m, rad and per s, s^2.

        A force that is not finite is sent as NO_VALUE; the amplifiers reject the whole frame then.
        """
        buffer = self._sent
        if self.contents.coils:
            quantise(coil_n, 1.0 / FORCE_N, buffer.setpoints)
        if self.contents.drives:
            _SETPOINTS.pack_into(
                buffer.bytes, buffer.drive_setpoints,
                _int32(beam[0] / BEAM_M), beam[1], beam[2],
                _int32(rotor[0] / ROTOR_RAD), rotor[1], rotor[2],
            )  # fmt: skip
        return self._frame(Kind.CYCLE, sequence)

    def readings(
        self,
        sequence: int,
        amplifiers: tuple[int, Array],
        sensors: tuple[int, Array],
        drives: tuple[int, int, Array],
    ) -> bytes:
        """Return the READINGS frame; arguments of roles that the port does not have are ignored.

        Args:
            sequence: sequence number of the CYCLE frame that it answers.
            amplifiers: state and forces (C,) in N.
            sensors: state and heights (S,) in m; nan for a missing value.
            drives: state, error code and position, velocity, force of each of AXES (3, 3).
        """
        buffer, contents = self._sent, self.contents
        if contents.coils:
            state, force = amplifiers
            _STATE.pack_into(buffer.bytes, buffer.amplifier_state, state, 0)
            quantise(force, 1.0 / FORCE_N, buffer.forces)
        if contents.sensors:
            state, gap = sensors
            _STATE.pack_into(buffer.bytes, buffer.sensor_state, state, 0)
            quantise(gap, 1.0 / GAP_M, buffer.gaps)
        if contents.drives:
            state, error, axes = drives
            numbers: list[float] = []
            for (position, velocity, force), unit in zip(
                axes.tolist(), (BEAM_M, BEAM_M, ROTOR_RAD), strict=True
            ):
                numbers += [_int32(position / unit), velocity, force]
            _DRIVES.pack_into(buffer.bytes, buffer.drives, state, 0, error, *numbers)
        return self._frame(Kind.READINGS, sequence)

    def request(self, sequence: int, request: int, index: int, value: int = 0) -> bytes:
        """Return a REQUEST frame."""
        _REQUEST.pack_into(self._sent.bytes, _HEADER.size, request, index, value)
        return self._frame(Kind.REQUEST, sequence)

    def answer(self, sequence: int, index: int, value: int) -> bytes:
        """Return an ANSWER frame."""
        _ANSWER.pack_into(self._sent.bytes, _HEADER.size, index, value)
        return self._frame(Kind.ANSWER, sequence)

    def accept(self, block: bytes) -> Header | Rejected:  # noqa: PLR0911 - one a check
        """Check a block between two zeros; return its header, or the reason if it is rejected."""
        buffer = self._received
        if not block:
            return Rejected.FRAMING
        n = cobs.decode(np.frombuffer(block, np.uint8), buffer.array)
        if n < 0:
            return Rejected.FRAMING
        end = n - _CRC.size
        if end < _HEADER.size:
            return Rejected.LENGTH
        raw = buffer.bytes
        if zlib.crc32(memoryview(raw)[:end]) != _CRC.unpack_from(raw, end)[0]:
            return Rejected.CHECKSUM
        version, kind, sequence = _HEADER.unpack_from(raw)
        if version != PROTOCOL:
            return Rejected.VERSION
        length = self._lengths.get(kind)
        if length is None:
            return Rejected.KIND
        if end != _HEADER.size + length:
            return Rejected.LENGTH
        if sequence >= CYCLES and kind in _OF_CYCLES:
            return Rejected.CYCLE
        return Header(_KINDS[kind], sequence)

    def setpoints(self, coil_n: Array) -> None:
        """Fill forces (C,) in N from the CYCLE frame accepted last; nan for a missing value."""
        scale(self._received.setpoints, FORCE_N, coil_n)

    def drive_setpoints(self, beam: Array, rotor: Array) -> None:
        """Fill beam (3,) in m, m/s, m/s^2 and rotor (3,) in rad from the CYCLE frame."""
        p, v, a, rp, rv, ra = _SETPOINTS.unpack_from(
            self._received.bytes, self._received.drive_setpoints
        )
        beam[:] = (p * BEAM_M if p >= -_MOST else math.nan), v, a
        rotor[:] = (rp * ROTOR_RAD if rp >= -_MOST else math.nan), rv, ra

    def amplifier_readings(self, coil_n: Array) -> int:
        """Fill forces (C,) in N from the last READINGS frame; return the state."""
        scale(self._received.forces, FORCE_N, coil_n)
        return self._received.bytes[self._received.amplifier_state]

    def sensor_readings(self, gap_m: Array) -> int:
        """Fill heights (S,) in m from the last READINGS frame, nan if missing; return state."""
        scale(self._received.gaps, GAP_M, gap_m)
        return self._received.bytes[self._received.sensor_state]

    def drive_readings(self, axes: Array) -> tuple[int, int]:
        """Fill position, velocity, force of AXES (3, 3) from READINGS; return state and error.

        A position is nan for a missing value.
        """
        state, _, error, *numbers = _DRIVES.unpack_from(self._received.bytes, self._received.drives)
        for i in range(0, len(numbers), 3):
            if numbers[i] < -_MOST:
                numbers[i] = math.nan
        axes.ravel()[:] = numbers
        axes[:2, 0] *= BEAM_M
        axes[2, 0] *= ROTOR_RAD
        return state, error

    def request_received(self) -> tuple[int, int, int]:
        """Return request, index and value of the last REQUEST frame."""
        request, index, value = _REQUEST.unpack_from(self._received.bytes, _HEADER.size)
        return request, index, value

    def answer_received(self) -> tuple[int, int]:
        """Return index and value of the last ANSWER frame."""
        index, value = _ANSWER.unpack_from(self._received.bytes, _HEADER.size)
        return index, value

    def _compile(self) -> None:
        """Compile the numba functions before the first cycle."""
        coil_n, gap_m, axes = (
            np.zeros(self.contents.coils), np.zeros(self.contents.sensors), np.zeros((3, 3)),
        )  # fmt: skip
        self.accept(self.cycle(0, coil_n, axes[0], axes[1])[:-1])
        if self.contents.coils:
            self.setpoints(coil_n)
            self.amplifier_readings(coil_n)
        if self.contents.sensors:
            self.sensor_readings(gap_m)

    def _frame(self, kind: Kind, sequence: int) -> bytes:
        buffer = self._sent
        raw, end = buffer.bytes, _HEADER.size + self._lengths[kind]
        _HEADER.pack_into(raw, 0, PROTOCOL, kind, sequence & 0xFFFF)
        _CRC.pack_into(raw, end, zlib.crc32(memoryview(raw)[:end]))
        n = cobs.encode(buffer.array[: end + _CRC.size], self._stuffed)
        return self._stuffed[:n].tobytes()


_KINDS = {kind.value: kind for kind in Kind}
_OF_CYCLES = {Kind.CYCLE.value, Kind.READINGS.value}


class _Buffer:
    """Bytes of a frame before encoding, and views of its values."""

    setpoints: NDArray[np.int16]
    forces: NDArray[np.int16]
    gaps: NDArray[np.int16]

    def __init__(self, length: int, contents: FrameContents) -> None:
        self.bytes = bytearray(length + contents.coils + contents.sensors + 8)
        self.array = np.frombuffer(self.bytes, np.uint8)
        coils, sensors = contents.coils, contents.sensors
        at = _HEADER.size
        self.setpoints = self._row(at, coils)
        self.drive_setpoints = at + 2 * coils
        self.amplifier_state = at
        if coils:
            self.forces = self._row(at + 2, coils)
            at += 2 + 2 * coils
        self.sensor_state = at
        if sensors:
            self.gaps = self._row(at + 2, sensors)
            at += 2 + 2 * sensors
        self.drives = at

    def _row(self, at: int, count: int) -> NDArray[np.int16]:
        return np.frombuffer(self.bytes, "<i2", count, at)


def _int32(value: float) -> int:
    """Return the nearest 32-bit integer; the most negative one for nan."""
    return round(min(max(value, -_MOST), _MOST)) if value == value else -_MOST - 1  # noqa: PLR0124
