"""Draw frames of the serial protocol, and judge levid's decoder of them by struct."""

from __future__ import annotations

import struct

import numpy as np
from hypothesis import strategies as st
from independent_frame_decoder import axis, equal, scaled

from levid.wire.serial.serial_frames import FrameContents, Kind, SerialFrames

CONTENTS = FrameContents(9, 9, True)
FORCE_N, GAP_M, BEAM_M, ROTOR_RAD = 1e-3, 2e-3 / 65536, 1e-9, 1e-7
BODIES = st.binary(min_size=80, max_size=80)


def frame(kind: Kind, sequence: int, noise: bytes) -> bytes:
    """Return a frame as levid sends it, without its final zero, with values from 80 bytes."""
    frames = SerialFrames(CONTENTS)
    values = np.frombuffer(noise[:18], "<i2") * 1e-3
    axes = np.frombuffer(noise[18:36], "<i2").reshape(3, 3) * 1e-5
    value = int.from_bytes(noise[36:40], "little")
    match kind:
        case Kind.CYCLE:
            sent = frames.cycle(sequence, values, axes[0], axes[2])
        case Kind.READINGS:
            sent = frames.readings(sequence, (1, values), (0, 3e-5 * values), (2, 0, axes))
        case Kind.REQUEST:
            sent = frames.request(sequence, 1, noise[40], value)
        case Kind.ANSWER:
            sent = frames.answer(sequence, noise[40], value)
    return sent[:-1]


def numbers_right(frames: SerialFrames, kind: int, body: bytes) -> bool:
    """Return whether the frame accepted last has the numbers of this body."""
    match kind:
        case Kind.CYCLE:
            force_n, motion = np.zeros(9), np.zeros((2, 3))
            frames.setpoints(force_n)
            frames.drive_setpoints(*motion)
            expected = [*axis(body[18:30], BEAM_M), *axis(body[30:], ROTOR_RAD)]
            return equal(force_n, scaled(body[:18], FORCE_N)) and equal(motion.ravel(), expected)
        case Kind.READINGS:
            return readings_right(frames, body)
        case Kind.REQUEST:
            return frames.request_received() == struct.unpack("<BBI", body)
        case _:
            return frames.answer_received() == struct.unpack("<BI", body)


def readings_right(frames: SerialFrames, body: bytes) -> bool:
    """Return whether these are the states and readings of a body."""
    force_n, gap_m, axes = np.zeros(9), np.zeros(9), np.zeros((3, 3))
    states = frames.amplifier_readings(force_n), frames.sensor_readings(gap_m)
    states += frames.drive_readings(axes)
    expected = [
        number
        for i, unit in enumerate((BEAM_M, BEAM_M, ROTOR_RAD))
        for number in axis(body[44 + 12 * i : 56 + 12 * i], unit)
    ]
    return (
        states == (body[0], body[20], body[40], body[42] | body[43] << 8)
        and equal(force_n, scaled(body[2:20], FORCE_N))
        and equal(gap_m, scaled(body[22:40], GAP_M))
        and equal(axes.ravel(), expected)
    )
