"""A transaction of the serial driver over a pseudo terminal, against pyserial's own reading.

Both sides check each frame of the other, kind and sequence number, in every call: what is not
answered, or not rightly, ends the run. Each contender has a port and a device of its own, a process
that answers at once with the forces it was told; all readings are taken out of their frame.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import pty
import tty
from collections.abc import Callable, Iterator

import numpy as np
import serial

from levid.benchmarks.bus.codecs import median_us
from levid.benchmarks.harness.table import Figure, Target
from levid.config.buses import SerialBus
from levid.drivers.bus_backend import AnswerTime
from levid.drivers.serial.transaction import TransactionPort
from levid.wire.device_protocol import CYCLES
from levid.wire.frame_rejection import Rejected
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
"""Far longer than any answer takes; who has none by then has failed."""
_ENDS_S = 5.0


def serial_figures(n: int) -> list[Figure]:
    """Return what a transaction and its parts cost; each contender has `n` calls."""
    with contextlib.ExitStack() as stack:
        ours = Driver(stack.enter_context(device()))
        stack.callback(ours.close)
        by_zero = Pyserial(stack.enter_context(device()), by_length=False)
        stack.callback(by_zero.close)
        by_length = Pyserial(stack.enter_context(device()), by_length=True)
        stack.callback(by_length.close)
        us = median_us({"ours": ours, "read_until": by_zero, "read": by_length}, n)
        for contender in (ours, by_zero, by_length):
            contender.readings.require()
    codec = median_us(parts(), 10 * n)
    label = "serial: the same with pyserial's"
    return [
        Figure("serial_encode_us", codec["encode"], "us", "serial: encode a cycle"),
        Figure("serial_decode_us", codec["decode"], "us", "serial: decode and check all readings"),
        Figure("serial_transaction_us", us["ours"], "us", "serial: the driver's, over a pty"),
        Figure(
            "serial_read_until_us",
            us["read_until"],
            "us",
            f"{label} read_until",
            "serial_transaction_us",
        ),
        Figure(
            "serial_read_until_times",
            us["read_until"] / us["ours"],
            "",
            "serial: times as long read_until takes",
            target=Target(least=LEAST_TIMES),
        ),
        Figure(
            "serial_read_us",
            us["read"],
            "us",
            f"{label} read, of a length that is known",
            "serial_transaction_us",
        ),
    ]


class Readings:
    """Takes all readings out of a frame that was accepted."""

    def __init__(self) -> None:
        self.force_n, self.gap_m, self.axes = np.zeros(9), np.zeros(9), np.zeros((3, 3))

    def take(self, frames: SerialFrames) -> None:
        frames.amplifier_readings(self.force_n)
        frames.sensor_readings(self.gap_m)
        frames.drive_readings(self.axes)

    def require(self) -> None:
        """Raise AssertionError where these are not the values that were sent, to half a count."""
        assert np.allclose(self.force_n, FORCES_N, rtol=0.0, atol=0.5 * FORCE_N)
        assert np.allclose(self.gap_m, GAPS_M, rtol=0.0, atol=0.5 * GAP_M)
        assert np.allclose(self.axes, AXES, rtol=1e-6)


class Driver:
    """A call is a transaction of the driver: sync, collect, and all readings."""

    def __init__(self, path: str) -> None:
        self.readings, self.cycle = Readings(), 0
        bus = SerialBus(port=path, baud=_BAUD, stale_cycles=0)  # the first that is missing raises
        self.port = TransactionPort("bench", bus, CONTENTS, AnswerTime(_ANSWER_S))
        self.port.open()
        self.port.coil_n[:] = FORCES_N
        self.port.beam[:] = self.port.rotor[:] = 0.0

    def __call__(self) -> None:
        port = self.port
        self.cycle += 1
        port.sync(self.cycle)
        port.collect()
        assert port.fresh, "no answer to this cycle"
        self.readings.take(port.frames)

    def close(self) -> None:
        self.port.close()


class Pyserial:
    """The same with pyserial: up to the zero that ends a frame, or as many bytes as it has."""

    def __init__(self, path: str, by_length: bool) -> None:
        self.readings, self.cycle = Readings(), 0
        self.frames, self.still = SerialFrames(CONTENTS), np.zeros(3)
        self.port = serial.Serial(path, _BAUD, timeout=_ANSWER_S)
        length = CONTENTS.on_wire(CONTENTS.readings_bytes)
        port = self.port
        self._read: Callable[[], bytes] = (
            (lambda: port.read(length)) if by_length else (lambda: port.read_until(b"\0"))
        )

    def __call__(self) -> None:
        self.cycle += 1
        number = self.cycle % CYCLES
        self.port.write(self.frames.cycle(number, FORCES_N, self.still, self.still))
        header = self.frames.accept(self._read()[:-1])
        assert header == Header(Kind.READINGS, number), header
        self.readings.take(self.frames)

    def close(self) -> None:
        self.port.close()


@contextlib.contextmanager
def device() -> Iterator[str]:
    """Let a process answer at a port; give the port's path.

    A thread of this process would make whoever reads byte by byte wait for it.
    """
    for call in parts().values():  # what is compiled by now, the process need not compile
        call()
    master, slave = pty.openpty()
    tty.setraw(slave)
    process = multiprocessing.get_context("fork").Process(
        target=_answer, args=(master,), daemon=True
    )
    process.start()
    try:
        yield os.ttyname(slave)
    finally:
        process.terminate()
        process.join(_ENDS_S)
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
                return  # which ends the run: nobody answers any more
            frames.setpoints(forces_n)
            answer = frames.readings(header.sequence, (1, forces_n), (0, GAPS_M), (2, 0, AXES))
            os.write(master, answer)


def parts() -> dict[str, Callable[[], object]]:
    """Return encoding and decoding alone; raises AssertionError where that gives other values."""
    host, still, readings = SerialFrames(CONTENTS), np.zeros(3), Readings()
    frame = SerialFrames(CONTENTS).readings(1, (1, FORCES_N), (0, GAPS_M), (2, 0, AXES))[:-1]

    def decode() -> Header | Rejected:
        header = host.accept(frame)
        readings.take(host)
        return header

    assert decode() == Header(Kind.READINGS, 1)
    readings.require()
    return {"encode": lambda: host.cycle(1, FORCES_N, still, still), "decode": decode}
