"""One port's transaction a cycle: setpoints out with the sync, readings back by the deadline."""

from __future__ import annotations

from time import perf_counter

import numpy as np

from ...config.buses import SerialBus
from ...wire.device_protocol import CYCLES, Request
from ...wire.frame_rejection import Rejected
from ...wire.serial.frame_splitter import FrameStream
from ...wire.serial.serial_frames import FrameContents, Header, Kind, SerialFrames
from ..amplifier_enabling import AmplifierWatch
from ..base import LinkError
from ..bus_backend import AnswerTime
from ..stale_readings import Watch
from .serial_line import SerialLine

_EXCHANGE_S = 0.1
_TRIES = 5
_MOST_DRAINED = 16
"""Chunks, more than a cycle brings."""


class TransactionPort:
    """What is to be sent with the next cycle, and what came back with this one.

    `coil_n` (C,) N, `beam` and `rotor` (3,) are sent by `sync`; after `collect` `frames` holds the
    readings of this cycle, or where they are stale those of an earlier one.
    """

    def __init__(
        self, name: str, bus: SerialBus, contents: FrameContents, answers: AnswerTime
    ) -> None:
        self.what = f"serial {name} ({bus.port})"
        self.frames = SerialFrames(contents)
        self.coil_n = np.zeros(contents.coils)
        # nan until they are told: drives go nowhere before somebody knows where they are.
        self.beam, self.rotor = np.full(3, np.nan), np.full(3, np.nan)
        self.stale_cycles = bus.stale_cycles
        self.watch = Watch(self.what, bus.stale_cycles)
        self.amplifiers: AmplifierWatch | None = None
        self.fresh = False
        self._line = SerialLine(name, bus)
        self._stream = FrameStream(self.frames.longest)
        self._reading = SerialFrames(contents)
        self._answers = answers
        self._deadline_s = 0.0
        self._cycle = 0
        self._collected = True
        self._unasked = 0
        self._questions: list[tuple[Request, int, int]] = []

    def open(self) -> None:
        """Open the port, anew if it is open; raises LinkError."""
        self._line.open()
        self._stream.clear()
        self._questions.clear()
        self._unasked = 0
        self._collected = True
        self.watch.reset()

    def close(self) -> None:
        """Let go of the port."""
        self._line.close()

    def sync(self, cycle: int, late_s: float = 0.0) -> None:
        """Begin a cycle: send setpoints, at which the device samples and answers."""
        # From the first moment on: what answers a late CYCLE is of a later moment.
        self._deadline_s = self._answers.deadline_s(perf_counter(), late_s)
        self._drain()
        self._unasked = 0  # what has not been answered by now is lost
        self.watch.begin()
        self._cycle = cycle % CYCLES
        self._collected, self.fresh = False, False
        self._line.write(self._setpoints())
        if self._questions:
            for question in self._questions:
                self._line.write(self.frames.request(0, *question))
            self._questions.clear()

    def send_setpoints(self) -> None:
        """Send the setpoints at once, in the cycle at hand."""
        self._line.write(self._setpoints())
        self._unasked += 1

    def ask(self, request: Request, index: int, value: int) -> None:
        """Ask with the next cycle; the answer goes to `amplifiers`."""
        self._questions.append((request, index, value))

    def collect(self) -> None:
        """Wait for this cycle's readings, by the deadline; the first caller of a cycle does."""
        if self._collected:
            return
        try:
            while not self.fresh:
                data = self._line.read(self._deadline_s)
                self._take_all(data)
                # What was there at the deadline has come; whoever never stops is not waited for.
                if not data or perf_counter() > self._deadline_s:
                    break
        finally:
            self._collected = True
        if self.fresh:
            self.watch.fresh()
        else:
            self.watch.missing()

    def exchange(self, request: Request, index: int, value: int) -> tuple[int, int]:
        """Ask and wait for the answer, between cycles; raises LinkError where none comes."""
        for attempt in range(1, _TRIES + 1):
            self._line.write(self.frames.request(attempt, request, index, value))
            deadline_s = perf_counter() + _EXCHANGE_S
            while perf_counter() < deadline_s and (data := self._line.read(deadline_s)):
                for block in self._stream.feed(data):
                    header = self._reading.accept(block)
                    if isinstance(header, Header) and header == Header(Kind.ANSWER, attempt):
                        return self._reading.answer_received()
        raise LinkError(f"{self.what}: nobody answers")

    def _setpoints(self) -> bytes:
        return self.frames.cycle(self._cycle, self.coil_n, self.beam, self.rotor)

    def _drain(self) -> None:
        """Take what came since the last cycle's reading: nothing, if all is well."""
        for _ in range(_MOST_DRAINED):
            data = self._line.read(0.0)
            if not data:
                return
            self._take_all(data)

    def _take_all(self, data: bytes) -> None:
        overlong = self._stream.overlong
        for block in self._stream.feed(data):
            self._take(block)
        if self._stream.overlong > overlong:
            self.watch.reject(Rejected.FRAMING)

    def _take(self, block: bytes) -> None:
        header = self._reading.accept(block)
        if isinstance(header, Rejected):
            self.watch.reject(header)
        elif header.kind is Kind.ANSWER:
            if self.amplifiers is not None:
                self.amplifiers.answered(*self._reading.answer_received())
        elif header.kind is not Kind.READINGS:
            self.watch.reject(Rejected.KIND)
        elif header.sequence != self._cycle:
            behind = (self._cycle - header.sequence) % CYCLES
            self.watch.reject(Rejected.COUNTER, behind)
        elif self.fresh and self._unasked:
            self._unasked -= 1  # the answer to setpoints that were sent at once
        elif self.fresh:
            self.watch.reject(Rejected.REPEATED)
        elif not self._collected:  # else it is too late, and was counted as missing
            # The readings stay where they were unpacked; the other codec takes the next frame.
            self.frames, self._reading = self._reading, self.frames
            self.fresh = True
            self.watch.arrived()
