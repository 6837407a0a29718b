"""Layout of the UDP packets: a kind, fields in SI units, and a CRC-32."""

from __future__ import annotations

import zlib
from enum import IntEnum
from typing import Any

import numpy as np

from levid.config.rig import RigConfig

_CRC_BYTES = 4


class Kind(IntEnum):
    """First byte of a packet."""

    CYCLE = 1
    READINGS = 2
    REQUEST = 3
    ANSWER = 4


class Frames:
    """Packs and unpacks packets for a number of coils and sensors."""

    def __init__(self, coils: int, sensors: int) -> None:
        def fields(*more: Any) -> np.dtype[np.void]:
            return np.dtype([("kind", "u1"), ("number", "<u2"), *more])

        self._types = {
            Kind.CYCLE: fields(("coil_n", "<f4", coils), ("beam", "<f8", 3), ("rotor", "<f8", 3)),
            Kind.READINGS: fields(
                ("amplifier_state", "u1"), ("coil_n", "<f4", coils),
                ("sensor_state", "u1"), ("gap_m", "<f4", sensors),
                ("drive_state", "u1"), ("drive_error", "<u2"), ("axes", "<f8", (3, 3)),
            ),
            Kind.REQUEST: fields(("request", "u1"), ("index", "u1"), ("value", "<u4")),
            Kind.ANSWER: fields(("index", "u1"), ("value", "<u4")),
        }  # fmt: skip
        self.cycle_bytes = self._types[Kind.CYCLE].itemsize + _CRC_BYTES
        self.readings_bytes = self._types[Kind.READINGS].itemsize + _CRC_BYTES

    @classmethod
    def of(cls, rig: RigConfig) -> Frames:
        """Return the packets of a rig."""
        return cls(len(rig.geometry.coil_x_m), len(rig.geometry.sensors_x_m))

    def pack(self, kind: Kind, number: int, **fields: Any) -> bytes:
        """Return a packet; `number` is the cycle, or the number of a request."""
        frame = np.zeros((), self._types[kind])
        for name, value in {"kind": kind, "number": number, **fields}.items():
            frame[name] = value
        body = frame.tobytes()
        return body + zlib.crc32(body).to_bytes(_CRC_BYTES, "little")

    def unpack(self, packet: bytes) -> np.void | None:
        """Return the fields of a packet, None if its kind, length or CRC is wrong."""
        body, crc = packet[:-_CRC_BYTES], packet[-_CRC_BYTES:]
        kinds = [kind for kind in Kind if body[:1] == bytes([kind])]
        if not kinds or len(body) != self._types[kinds[0]].itemsize:
            return None
        if zlib.crc32(body).to_bytes(_CRC_BYTES, "little") != crc:
            return None
        found: np.void = np.frombuffer(body, self._types[kinds[0]])[0]
        return found
