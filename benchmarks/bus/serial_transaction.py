"""Time a transaction of the serial driver over a pseudo terminal, against pyserial's read_until.

Each contender has a port and a device, a process that answers every CYCLE frame at once. A missing
or wrong answer ends the run. All readings are decoded.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import pty
import tty
from collections.abc import Iterator

import numpy as np
import serial

from levid.benchmarks.bus.can_codec_speed import median_us
from levid.benchmarks.harness.benchmark_runner import Figure, Target
from levid.config.buses import SerialBus
from levid.drivers.bus_backend import AnswerTime
from levid.drivers.serial.transaction import TransactionPort
from levid.wire.device_protocol import CYCLES
from levid.wire.serial.frame_splitter import FrameStream
from levid.wire.serial.serial_frames import (
    FORCE_N,
    GAP_M,
    FrameContents,
    Header,
    Kind,
    SerialFrames,
)

CONTENTS = FrameContents(9, 9, True)
FORCES_N, GAPS_M = np.arange(1.0, 10.0), np.arange(9) * 1e-5
AXES = np.arange(9.0).reshape(3, 3) * 1e-3
LEAST_TIMES = 3.0
_BAUD = 3_000_000
_ANSWER_S = 1.0
"""Timeout of an answer, far longer than any answer takes."""
_ENDS_S = 5.0


def serial_figures(n: int) -> list[Figure]:
    """Return the times of a transaction; each contender has `n` calls."""
    with contextlib.ExitStack() as stack:
        ours = Driver(stack.enter_context(device()))
        stack.callback(ours.port.close)
        theirs = Pyserial(stack.enter_context(device()))
        stack.callback(theirs.port.close)
        us = median_us({"ours": ours, "theirs": theirs}, n)
        for contender in (ours, theirs):
            contender.readings.require()
    return [
        Figure("serial_transaction_us", us["ours"], "us", "serial: transaction over a pty"),
        Figure("serial_read_until_us", us["theirs"], "us", "serial: the same, pyserial read_until"),
        Figure(
            "serial_read_until_times", us["theirs"] / us["ours"], "",
            "serial: read_until, times as long", target=Target(least=LEAST_TIMES),
        ),
    ]  # fmt: skip


class Readings:
    """The readings in a frame that was accepted."""

    def __init__(self) -> None:
        self.force_n, self.gap_m, self.axes = np.zeros(9), np.zeros(9), np.zeros((3, 3))

    def take(self, frames: SerialFrames) -> None:
        frames.amplifier_readings(self.force_n)
        frames.sensor_readings(self.gap_m)
        frames.drive_readings(self.axes)

    def require(self) -> None:
        """Raise AssertionError if these are not the values that were sent, to half a count."""
        assert np.allclose(self.force_n, FORCES_N, rtol=0.0, atol=0.5 * FORCE_N)
        assert np.allclose(self.gap_m, GAPS_M, rtol=0.0, atol=0.5 * GAP_M)
        assert np.allclose(self.axes, AXES, rtol=1e-6)


class Driver:
    """Each call is a transaction of the driver: sync, collect, and all readings."""

    def __init__(self, path: str) -> None:
        self.readings, self.cycle = Readings(), 0
        bus = SerialBus(port=path, baud=_BAUD, stale_cycles=0)  # the first missing answer raises
        self.port = TransactionPort("bench", bus, CONTENTS, AnswerTime(_ANSWER_S))
        self.port.open()
        self.port.coil_n[:] = FORCES_N
        self.port.beam[:] = self.port.rotor[:] = 0.0

    def __call__(self) -> None:
        self.cycle += 1
        self.port.sync(self.cycle)
        self.port.collect()
        assert self.port.fresh, "no answer to this cycle"
        self.readings.take(self.port.frames)


class Pyserial:
    """The same with pyserial, which reads up to the zero at the end of a frame."""

    def __init__(self, path: str) -> None:
        self.readings, self.cycle = Readings(), 0
        self.frames, self.still = SerialFrames(CONTENTS), np.zeros(3)
        self.port = serial.Serial(path, _BAUD, timeout=_ANSWER_S)

    def __call__(self) -> None:
        self.cycle += 1
        number = self.cycle % CYCLES
        self.port.write(self.frames.cycle(number, FORCES_N, self.still, self.still))
        header = self.frames.accept(self.port.read_until(b"\0")[:-1])
        assert header == Header(Kind.READINGS, number), header
        self.readings.take(self.frames)


@contextlib.contextmanager
def device() -> Iterator[str]:
    """Run a process that answers at a port; yield the path of the port.

    With a thread of this process, a contender that reads byte by byte would wait for that thread.
    """
    master, slave = pty.openpty()
    tty.setraw(slave)
    context = multiprocessing.get_context("fork")
    process = context.Process(target=_answer, args=(master,), daemon=True)
    process.start()
    try:
        yield os.ttyname(slave)
    finally:
        process.kill()
        process.join(_ENDS_S)
        os.close(master)
        os.close(slave)


def _answer(master: int) -> None:
    frames, forces_n = SerialFrames(CONTENTS), np.zeros(9)
    stream = FrameStream(frames.longest)
    while True:
        for block in stream.feed(os.read(master, 4096)):
            header = frames.accept(block)
            if not isinstance(header, Header) or header.kind is not Kind.CYCLE:
                return  # the contender times out
            frames.setpoints(forces_n)
            answer = frames.readings(header.sequence, (1, forces_n), (0, GAPS_M), (2, 0, AXES))
            os.write(master, answer)
