"""Electronics at the far end of a UDP link, with the simulated plant behind them."""

from __future__ import annotations

import select
import socket
import threading
import time
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from levid.config.buses import RoleOptions
from levid.config.rig import RigConfig
from levid.sim.electronics.emulated_devices import Core
from levid.sim.electronics.faults import Injector, Outgoing

from .bus import UdpBus
from .frames import Frames, Kind

_LONGEST = 65_536


class UdpElectronics:
    """Answers on a UDP port from `start` to `stop`."""

    def __init__(
        self,
        name: str,
        rig: RigConfig,
        folder: Path,  # noqa: ARG002 - every emulator has it, for files named in RIG.yaml
        roles: Mapping[str, RoleOptions],  # noqa: ARG002 - here always all three
        core: Core,
        injector: Injector,
    ) -> None:
        bus: UdpBus = rig.buses["udp"][name]
        self._address = bus.host, bus.port
        self._frames, self._core, self._injector = Frames.of(rig), core, injector
        self._outgoing = Outgoing(injector)
        self._cycle = -1
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name=f"levid-{name}", daemon=True)

    def start(self) -> None:
        """Bind the port and answer from now on; raises OSError if the port is in use."""
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind(self._address)
        self._thread.start()

    def stop(self) -> None:
        """Stop answering and close the port."""
        self._stopping.set()
        if self._thread.is_alive():
            self._thread.join()
        self._socket.close()

    def _run(self) -> None:
        patience_s = min(1.5 * self._core.period_s, 0.1)
        while not self._stopping.is_set():
            if select.select([self._socket], [], [], patience_s)[0]:
                packet, host = self._socket.recvfrom(_LONGEST)
                if self._injector.receives:
                    for answer in self._answers(packet):
                        self._socket.sendto(answer, host)
                    continue
            self._core.tick(time.monotonic())  # without a host, setpoints expire

    def _answers(self, packet: bytes) -> list[bytes]:
        frame, core = self._frames.unpack(packet), self._core
        if frame is not None and frame["kind"] == Kind.REQUEST:
            index, value = core.request(*(int(frame[k]) for k in ("request", "index", "value")))
            dropped = "drop" in self._injector.wire
            fields = {"index": index, "value": value}
            answer = self._frames.pack(Kind.ANSWER, frame["number"], **fields)
            return [] if dropped else [answer]
        if frame is None or frame["kind"] != Kind.CYCLE:
            return []
        cycle = int(frame["number"])
        with core.lock:
            if "drop-setpoints" not in self._injector.wire:
                core.setpoints(frame["coil_n"].astype(float))
                core.drive_setpoints([np.array([frame["beam"], frame["rotor"]])])
            core.begin(cycle)
            core.apply_setpoints(renews=cycle != self._cycle)
            self._cycle = cycle
            readings = self._frames.pack(
                Kind.READINGS, cycle,
                amplifier_state=core.reported_state, coil_n=core.force_n,
                sensor_state=core.sensor_state, gap_m=core.gap_m,
                drive_state=core.drive_state, drive_error=core.drive_error, axes=core.axes,
            )  # fmt: skip
        return [data for _, data in self._outgoing.through([(0, readings)])]
