"""A serial port takes the first readings of its cycle, whatever else is on the line."""

from __future__ import annotations

import struct
from types import SimpleNamespace

from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, rule
from independent_frame_decoder import CHANGES, CYCLES, changed, serial_frame
from serial_frame_fuzz_checks import BODIES, CONTENTS, frame, readings_right

from levid.config.buses import SerialBus
from levid.drivers.bus_backend import AnswerTime
from levid.drivers.serial.transaction import TransactionPort
from levid.drivers.stale_readings import Watch
from levid.wire.serial.serial_frames import Kind

NEVER = 1 << 30
CUTS = st.integers(1, 150)
"""Bytes of a frame that arrive together with the frame before; the longest frame has 91."""


class Line:
    """A line that gives its chunks one by one, and keeps what was read."""

    def __init__(self) -> None:
        self.coming: list[bytes] = []
        self.was_read = b""

    def open(self) -> None: ...

    def write(self, data: bytes) -> None: ...

    def read(self, _deadline_s: float) -> bytes:
        data = self.coming.pop(0) if self.coming else b""
        self.was_read += data
        return data


class NoisyLine(RuleBasedStateMachine):
    """Bytes arrive in chunks of any length; `collect` ends a cycle."""

    def __init__(self) -> None:
        super().__init__()
        bus = SerialBus(port="/", baud=9600)
        self.port = TransactionPort("noise", bus, CONTENTS, AnswerTime(1e9))
        self.port.watch = Watch("noise", NEVER)
        self.line = self.port._line = Line()
        self.answered: list[tuple[int, int]] = []
        self.port.amplifiers = SimpleNamespace(answered=lambda *it: self.answered.append(it))
        self.rest, self.cycle, self.longest = b"", 0, self.port.frames.longest

    @initialize(cycle=st.integers(0, CYCLES - 1))
    def begin(self, cycle: int) -> None:
        self.port.open()
        self._sync(cycle)

    @rule(data=st.binary(min_size=1, max_size=300))
    def noise_arrives(self, data: bytes) -> None:
        self.line.coming.append(data)

    @rule(kind=st.sampled_from(Kind), noise=BODIES, age=st.integers(0, 20), cut=CUTS)
    def frame_arrives(self, kind: Kind, noise: bytes, age: int, cut: int) -> None:
        self._arrive(frame(kind, (self.cycle - age) % CYCLES, noise) + b"\0", cut)

    @rule(noise=BODIES, cut=CUTS)
    def readings_arrive(self, noise: bytes, cut: int) -> None:
        self._arrive(frame(Kind.READINGS, self.cycle, noise) + b"\0", cut)

    @rule(noise=BODIES, changes=CHANGES, cut=CUTS)
    def changed_readings_arrive(self, noise: bytes, changes, cut: int) -> None:
        self._arrive(changed(frame(Kind.READINGS, self.cycle, noise), changes) + b"\0", cut)

    @rule(step=st.integers(1, 3))
    def collect(self, step: int) -> None:
        """End a cycle, and begin the next one: the rest of the chunks is drained there."""
        self.port.collect()
        heard = self._heard()
        readings = [body for kind, n, body in heard if (kind, n) == (0x81, self.cycle)]
        assert self.port.fresh == bool(readings)
        if readings:
            assert readings_right(self.port.frames, readings[0])
        self._sync((self.cycle + step) % CYCLES)

    def _arrive(self, data: bytes, cut: int) -> None:
        """Add a frame, its first bytes to the chunk of the one before."""
        self.line.coming[-1:] = [b"".join(self.line.coming[-1:]) + data[:cut]]
        if data[cut:]:
            self.line.coming.append(data[cut:])

    def _sync(self, cycle: int) -> None:
        self.cycle = cycle
        self.port.sync(cycle)
        self._heard()

    def _heard(self) -> list[tuple[int, int, bytes]]:
        """Return the frames that were read since the last call; all answers are handed on."""
        *blocks, self.rest = (self.rest + self.line.was_read).split(b"\0")
        self.line.was_read = b""
        short = (block for block in blocks if len(block) <= self.longest)
        heard = [found for block in short if (found := serial_frame(block)) is not None]
        answers = [struct.unpack("<BI", body) for kind, _, body in heard if kind == Kind.ANSWER]
        assert self.answered == answers
        self.answered.clear()
        return heard


TestNoisyLine = NoisyLine.TestCase
TestNoisyLine.settings = settings(max_examples=settings.default.max_examples // 10)
