"""Emulate electronics on a CAN bus: amplifiers and ADC by the DBC, drives as CANopen nodes."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ...config.base import ConfigError
from ...config.buses import CanBus, CanDriveOptions, RoleOptions
from ...config.rig import RigConfig
from ...wire.can.can_bus import Ages, FrameBus, open_bus
from ...wire.can.can_frames import Fields, load_frames
from ...wire.can.cia402 import SYNC_COUNTER, SYNC_ID, cycle_of_sync
from ...wire.can.kernel_frame import BUS_OFF_ID
from ...wire.can.python_can_interface_table import check_bus
from ...wire.frame_rejection_reasons import Rejected
from .emulated_devices import Core
from .faults import Injector, Outgoing

Frame = tuple[int, bytes]

_SOFTWARE = {"levid_local", "udp_multicast", "virtual"}
"""Interfaces without a controller, which transmit error frames like other frames. So does vcan; a
real controller would send something else."""
_WITHOUT_DEVICE = Path("/sys/devices/virtual/net")
_ERROR_BYTES = 8


class CanElectronics:
    """Answers on one bus from `start` to `stop`; `opened` is a bus that is open already.

    `drives` are its CANopen nodes, None without any.
    """

    def __init__(
        self,
        name: str,
        rig: RigConfig,
        folder: Path,
        roles: Mapping[str, RoleOptions],
        core: Core,
        injector: Injector,
        opened: FrameBus | None = None,
    ) -> None:
        self._config, self._core, self._injector = rig.can[name], core, injector
        check_bus(f"can.{name}", self._config)
        self._ages = Ages(self._config.interface)
        dbc = folder / self._config.dbc if self._config.dbc else None
        self._frames = load_frames(dbc, core.coils, core.sensors, self._config.fd)
        self._outgoing = Outgoing(injector)
        self._handlers: dict[int, Callable[[int, bytes], None]] = {}
        self._coil_n = np.zeros(core.coils)
        self._cycle, self._applied = 0, -1
        self._set = 0
        self._amplifiers, self._sensors = "amplifiers" in roles, "sensors" in roles
        frames = self._frames
        if self._amplifiers or self._sensors:
            self._handlers[frames.sync.can_id] = self._sync
        if self._amplifiers:
            self._handlers |= dict.fromkeys(frames.setpoint.ids, self._setpoint)
            self._handlers[frames.request.can_id] = self._request_handler(
                frames.request, frames.answer
            )
        if self._sensors:
            self._handlers[frames.sensor_request.can_id] = self._request_handler(
                frames.sensor_request, frames.sensor_answer
            )
        self.drives: Any = None
        options = roles.get("drives")
        if isinstance(options, CanDriveOptions):
            from .drive_nodes import DriveNodes

            eds = folder / options.eds if options.eds else None
            self.drives = DriveNodes(rig, options, eds, core, injector, self._send)
            self._handlers[SYNC_ID] = self._drives_sync
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self.serve, name=f"levid-{name}", daemon=True)
        self._bus = opened
        self._off = False

    def start(self) -> None:
        """Open the bus and answer from now on; raises ConfigError."""
        if self._bus is None:
            self._open()
        if self.drives is not None:
            self.drives.boot()
        self._thread.start()

    def stop(self) -> None:
        """Stop answering and close the bus."""
        self._stopping.set()
        if self._thread.is_alive():
            self._thread.join()
        self._close()

    def _open(self) -> None:
        config = self._config
        try:
            self._bus = open_bus(config)
        except Exception as error:  # noqa: BLE001 - interfaces raise any exception
            raise ConfigError(f"can: {config.interface} {config.channel}: {error}") from None

    def _close(self) -> None:
        bus, self._bus = self._bus, None
        if bus is not None:
            bus.shutdown()

    def serve(self) -> None:
        """Answer in the calling thread until `stop`."""
        patience_s = min(1.5 * self._core.period_s, 0.1)
        while not self._stopping.is_set():
            silent_s = time.monotonic() + patience_s
            assert self._bus is not None
            try:
                frame = self._bus.receive(patience_s)
            except Exception:  # noqa: BLE001 - an interface that is down may come back
                time.sleep(max(silent_s - time.monotonic(), 0.0))
                frame = None
            if frame is None and self.drives is not None and self._injector.receives:
                self.drives.poll()
            self._send_bus_off()
            if frame is None or not self._injector.receives:
                self._core.tick(min(silent_s, time.monotonic()))
                continue
            can_id, data, stamp_s = frame
            handler = self._handlers.get(can_id)
            if handler is not None:
                handler(can_id, data)
            elif self.drives is not None and can_id >= 0:
                self.drives.handle_frame(can_id, data)
            # All frames before this one have been handled.
            self._core.tick(time.monotonic() - (self._ages.of(stamp_s) or 0.0))

    def _send(self, can_id: int, data: bytes) -> None:
        if self._bus is not None:
            with contextlib.suppress(Exception):  # without a receiver the frame is lost
                self._bus.send(can_id, data)

    def _send_bus_off(self) -> None:
        """Send one error frame of bus-off, as the driver of the host would."""
        was_off, self._off = self._off, "bus-off" in self._injector.wire
        if self._off and not was_off and _transmits_errors(self._config):
            self._send(BUS_OFF_ID, bytes(_ERROR_BYTES))

    def _sync(self, _: int, data: bytes) -> None:
        numbers = self._frames.sync.decode(data)
        if isinstance(numbers, Rejected):
            return
        core, frames = self._core, self._frames
        self._cycle = numbers[0]
        batch: list[Frame] = []
        with core.lock:
            core.begin(self._cycle)
            if self._amplifiers and self._cycle != self._applied:
                self._applied = self._cycle
                core.apply_setpoints()
            if self._sensors:
                batch += frames.gap.encode(core.gap_m, self._cycle, core.sensor_state)
            if self._amplifiers:
                batch += frames.force.encode(core.force_n, self._cycle, core.reported_state)
        frames.setpoint.begin()
        for frame in self._outgoing.through(batch):
            self._send(*frame)

    def _drives_sync(self, _: int, data: bytes) -> None:
        if self.drives.counts_syncs:
            if len(data) != 1 or not 1 <= data[0] <= SYNC_COUNTER:
                return
            self._core.begin(*cycle_of_sync(data[0], self.drives.every))
        elif data:
            return
        self.drives.poll()
        for frame in self.drives.sync():
            self._send(*frame)

    def _setpoint(self, can_id: int, data: bytes) -> None:
        if "drop-setpoints" in self._injector.wire:
            return
        setpoint = self._frames.setpoint
        # A second set in a cycle is an immediate zero force. Its number starts a new set even if
        # frames of the first set are missing.
        number = setpoint.tag(data)
        if setpoint.complete or number != self._set:
            setpoint.begin()
            self._set = number
        if setpoint.accept(can_id, data, self._cycle) is not None or not setpoint.complete:
            return
        if setpoint.finish(self._coil_n) is None:
            self._core.setpoints(self._coil_n)

    def _request_handler(self, request: Fields, answer: Fields) -> Callable[[int, bytes], None]:
        def handle(_: int, data: bytes) -> None:
            numbers = request.decode(data)
            if not isinstance(numbers, Rejected) and "drop" not in self._injector.wire:
                self._send(*answer.encode(*self._core.request(*numbers)))

        return handle


def _transmits_errors(bus: CanBus) -> bool:
    if bus.interface == "socketcan":
        return (_WITHOUT_DEVICE / str(bus.channel)).exists()
    return bus.interface in _SOFTWARE
