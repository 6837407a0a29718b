"""One transaction per cycle on a serial port: send setpoints, receive readings by a deadline."""

from __future__ import annotations

from time import perf_counter

import numpy as np

from ...config.buses import SerialBus
from ...wire.device_protocol import CYCLES, Request
from ...wire.frame_rejection_reasons import Rejected
from ...wire.serial.frame_splitter import FrameStream
from ...wire.serial.serial_frames import FrameContents, Header, Kind, SerialFrames
from ..amplifier_enabling import AmplifierWatch
from ..base import LinkError
from ..bus_backend import AnswerTime
from ..remedies import no_serial_answer
from ..stale_readings import Watch
from .serial_line import SerialLine

_EXCHANGE_S = 0.1
_ATTEMPTS = 5
_MOST_CHUNKS = 16
"""Chunks; more than a cycle receives."""


class TransactionPort:
    """Setpoints of the next cycle and readings of this one, on one port.

    `sync` sends `coil_n` (C,) in N, `beam` and `rotor` (3,). After `collect`, `frames` holds the
    readings: of this cycle if `fresh`, else of an earlier one. `line` is used instead of a new one.
    """

    def __init__(
        self,
        name: str,
        bus: SerialBus,
        contents: FrameContents,
        answers: AnswerTime,
        line: SerialLine | None = None,
    ) -> None:
        self.what = f"serial {name} ({bus.port})"
        self.frames = SerialFrames(contents)
        self.coil_n = np.zeros(contents.coils)
        # nan until written: drives hold until the loop has read their position.
        self.beam, self.rotor = np.full(3, np.nan), np.full(3, np.nan)
        self.stale_cycles = bus.stale_cycles
        self.watch = Watch(self.what, bus.stale_cycles)
        self.amplifiers: AmplifierWatch | None = None
        self.fresh = False
        self._bus = bus
        self._line = line or SerialLine(name, bus)
        self._stream = FrameStream(self.frames.longest)
        self._reading = SerialFrames(contents)
        self._answers = answers
        self._deadline_s = 0.0
        self._cycle = 0
        self._collected = True
        self._extra_answers = 0
        self._requests: list[tuple[Request, int, int]] = []

    def open(self) -> None:
        """Open the port, again if it is open; raises LinkError."""
        self._line.open()
        self._stream.clear()
        self._requests.clear()
        self._extra_answers = 0
        self._collected = True
        self.watch.reset()

    def close(self) -> None:
        """Close the port."""
        self._line.close()

    def sync(self, cycle: int, late_s: float = 0.0) -> None:
        """Begin a cycle: send the setpoints, at which the device samples and answers."""
        # Before anything else: the answer to a late CYCLE frame is sampled late too.
        self._deadline_s = self._answers.deadline_s(perf_counter(), late_s)
        self._drain()
        self._extra_answers = 0  # an answer that is still missing is lost
        self.watch.begin()
        self._cycle = cycle % CYCLES
        self._collected, self.fresh = False, False
        self._line.write(self._setpoints())
        if self._requests:
            for request in self._requests:
                self._line.write(self.frames.request(0, *request))
            self._requests.clear()

    def send_setpoints(self) -> None:
        """Send the setpoints at once, with the number of this cycle."""
        self._line.write(self._setpoints())
        self._extra_answers += 1

    def ask(self, request: Request, index: int, value: int) -> None:
        """Send a request with the next cycle; the answer goes to `amplifiers`."""
        self._requests.append((request, index, value))

    def collect(self) -> None:
        """Wait for this cycle's readings until the deadline; raises LinkError or StaleError.

        Only the first call in a cycle waits.
        """
        if self._collected:
            return
        try:
            while not self.fresh:
                data = self._line.read(self._deadline_s)
                self._handle_data(data)
                # A device that sends without end must not hold the loop after the deadline.
                if not data or perf_counter() > self._deadline_s:
                    break
        finally:
            self._collected = True
        if self.fresh:
            self.watch.fresh()
        else:
            self.watch.missing()

    def exchange(self, request: Request, index: int, value: int) -> tuple[int, int]:
        """Send a request between cycles and return its answer; raises LinkError on a timeout."""
        for attempt in range(1, _ATTEMPTS + 1):
            self._line.write(self.frames.request(attempt, request, index, value))
            deadline_s = perf_counter() + _EXCHANGE_S
            while perf_counter() < deadline_s and (data := self._line.read(deadline_s)):
                for block in self._stream.feed(data):
                    header = self._reading.accept(block)
                    if isinstance(header, Header) and header == Header(Kind.ANSWER, attempt):
                        return self._reading.answer_received()
        raise LinkError(
            f"{self.what}: no answer: {no_serial_answer(self._bus.port, self._bus.baud)}"
        )

    def _setpoints(self) -> bytes:
        return self.frames.cycle(self._cycle, self.coil_n, self.beam, self.rotor)

    def _drain(self) -> None:
        """Handle frames that arrived after the last cycle's reading; normally there are none."""
        for _ in range(_MOST_CHUNKS):
            data = self._line.read(0.0)
            if not data:
                return
            self._handle_data(data)

    def _handle_data(self, data: bytes) -> None:
        overlong = self._stream.overlong
        for block in self._stream.feed(data):
            self._handle_frame(block)
        if self._stream.overlong > overlong:
            self.watch.reject(Rejected.FRAMING)

    def _handle_frame(self, block: bytes) -> None:
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
        elif self.fresh and self._extra_answers:
            self._extra_answers -= 1  # the answer to send_setpoints
        elif self.fresh:
            self.watch.reject(Rejected.REPEATED)
        elif not self._collected:  # else it is late and was counted as missing
            # The codecs swap: this one keeps the readings, the other unpacks the next frame.
            self.frames, self._reading = self._reading, self.frames
            self.fresh = True
            self.watch.arrived()
