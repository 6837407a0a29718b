"""Host's end of the UDP link: one transaction per cycle, and requests between cycles."""

from __future__ import annotations

import select
import socket
from contextlib import suppress
from time import perf_counter
from typing import Any

import numpy as np

from levid.config.rig import RigConfig
from levid.drivers.amplifier_enabling import AmplifierWatch
from levid.drivers.base import LinkError
from levid.drivers.bus_backend import AnswerTime
from levid.drivers.stale_readings import Watch
from levid.wire.device_protocol import CYCLES, Request
from levid.wire.frame_rejection_reasons import Rejected

from .bus import UdpBus
from .frames import Frames, Kind

_ANSWER_S = 0.1
_ATTEMPTS = 5
_LONGEST = 65_536


class UdpLink:
    """Sends setpoints and receives readings; `readings` are fresh if they are of this cycle."""

    def __init__(self, name: str, rig: RigConfig, answers: AnswerTime) -> None:
        bus: UdpBus = rig.buses["udp"][name]
        self.what = f"udp {name} ({bus.place})"
        self.stale_cycles = bus.stale_cycles
        self.watch = Watch(self.what, bus.stale_cycles)
        self.amplifiers: AmplifierWatch | None = None
        self.coil_n = np.zeros(len(rig.geometry.coil_x_m))
        # nan: drives hold until the loop knows where they are.
        self.beam, self.rotor = np.full(3, np.nan), np.full(3, np.nan)
        self.readings: Any = None
        self.fresh = False
        self._address = bus.host, bus.port
        self._frames, self._answers = Frames.of(rig), answers
        self._socket: socket.socket | None = None
        self._cycle, self._deadline_s, self._collected = 0, 0.0, True

    def open(self) -> None:
        """Open the socket, again if it is open; raises LinkError."""
        self.close()
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self._socket.connect(self._address)
        except OSError as error:
            raise LinkError(f"{self.what}: {error}") from None
        self.watch.reset()

    def close(self) -> None:
        """Close the socket; safe to call twice."""
        closing, self._socket = self._socket, None
        if closing is not None:
            closing.close()

    def sync(self, cycle: int, late_s: float) -> None:
        """Begin a cycle: send the setpoints, at which the electronics sample and answer."""
        self._deadline_s = self._answers.deadline_s(perf_counter(), late_s)
        self.watch.begin()
        self._cycle, self.fresh, self._collected = cycle % CYCLES, False, False
        self.send_setpoints()

    def send_setpoints(self) -> None:
        """Send the setpoints with the number of this cycle."""
        setpoints = {"coil_n": self.coil_n, "beam": self.beam, "rotor": self.rotor}
        self._send(self._frames.pack(Kind.CYCLE, self._cycle, **setpoints))

    def collect(self) -> None:
        """Wait for this cycle's readings until the deadline; raises StaleError.

        The first role that reads in a cycle waits.
        """
        if self._collected:
            return
        self._collected = True
        while not self.fresh and (packet := self._receive(self._deadline_s)):
            self._accept(packet)
        if self.fresh:
            self.watch.fresh()
        else:
            self.watch.missing()

    def ask(self, request: Request, index: int, value: int) -> None:
        """Send a request; its answer goes to `amplifiers`."""
        self._send(self._request(0, request, index, value))

    def exchange(self, request: Request, index: int, value: int) -> tuple[int, int]:
        """Send a request between cycles and return its answer; raises LinkError on a timeout."""
        for number in range(1, _ATTEMPTS + 1):
            self._send(self._request(number, request, index, value))
            deadline_s = perf_counter() + _ANSWER_S
            while perf_counter() < deadline_s and (packet := self._receive(deadline_s)):
                frame = self._frames.unpack(packet)
                if frame is not None and (frame["kind"], frame["number"]) == (Kind.ANSWER, number):
                    return int(frame["index"]), int(frame["value"])
        raise LinkError(f"{self.what}: no answer; check address, cable and power")

    def _request(self, number: int, request: int, index: int, value: int) -> bytes:
        fields = {"request": request, "index": index, "value": value}
        return self._frames.pack(Kind.REQUEST, number, **fields)

    def _accept(self, packet: bytes) -> None:
        frame = self._frames.unpack(packet)
        if frame is None:
            self.watch.reject(Rejected.CHECKSUM)
        elif frame["kind"] == Kind.ANSWER and self.amplifiers is not None:
            self.amplifiers.answered(int(frame["index"]), int(frame["value"]))
        elif frame["kind"] == Kind.READINGS and frame["number"] != self._cycle:
            self.watch.reject(Rejected.COUNTER, (self._cycle - int(frame["number"])) % CYCLES)
        elif frame["kind"] == Kind.READINGS:
            self.readings, self.fresh = frame, True
            self.watch.arrived()

    def _send(self, packet: bytes) -> None:
        if self._socket is not None:
            with suppress(OSError):  # missing answers tell: the watch counts them
                self._socket.send(packet)

    def _receive(self, deadline_s: float) -> bytes:
        """Return a packet, empty if none comes by the deadline."""
        if self._socket is None:
            raise LinkError(f"{self.what}: the socket is closed")
        wait_s = max(deadline_s - perf_counter(), 0.0)
        if not select.select([self._socket], [], [], wait_s)[0]:
            return b""
        try:
            return self._socket.recv(_LONGEST)
        except OSError:  # refused: no electronics on that port yet
            return b""
