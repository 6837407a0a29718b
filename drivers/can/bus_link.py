"""Send frames on a CAN bus, and dispatch received frames to listeners until a deadline."""

from __future__ import annotations

from collections.abc import Callable
from time import perf_counter
from typing import NoReturn

from ...config.buses import CanBus
from ...wire.can.can_bus import Ages, FrameBus, open_bus
from ...wire.can.kernel_frame import BusOffError
from ..base import DriverError, LinkError
from ..bus_lock import BusLock
from ..remedies import BUS_OFF, can_problem, network_problem, no_can_answer

_MOST_FRAMES = 1000
"""Most frames that `drain` handles, more than a cycle brings; the only bound without timestamps."""

Listener = Callable[[int, bytes], None]


class CanLink:
    """A bus that can be lost and reopened; a failure is a LinkError that names bus and cause.

    `opened` is used until it is lost, so that a caller can bring a bus of its own.
    """

    def __init__(self, name: str, bus: CanBus, opened: FrameBus | None = None) -> None:
        self.what = f"can {name} ({bus.interface} {bus.channel})"
        self._config = bus
        self._listeners: dict[int, Listener] = {}
        self._bus = opened
        self._to_close: list[FrameBus] = []  # lost, not shut down yet
        self._ages, self._stamped = Ages(bus.interface), False
        self.received_s = 0.0
        """Time of the last received frame (perf_counter), by the timestamp of hardware or kernel if
        the interface has one: without the delays of this process."""
        # A virtual bus is inside this process.
        self._lock = None if bus.interface == "virtual" else BusLock(bus.place)

    def open(self) -> None:
        """Open the bus, again if it is open; raises LinkError, also if another loop uses it."""
        self._close_all()
        if self._lock is not None:
            self._lock.require(self.what)
        try:
            self._bus = open_bus(self._config)
        except Exception as error:  # noqa: BLE001 - interfaces raise any exception
            why = network_problem(self._config) or can_problem(self._config, error)
            raise LinkError(f"{self.what}: cannot be opened: {why}") from None

    def close(self) -> None:
        """Close the bus; safe to call twice."""
        self._close_all()
        if self._lock is not None:
            self._lock.release()

    def _close_all(self) -> None:
        self._close_later()
        while self._to_close:
            self._to_close.pop().shutdown()

    def _close_later(self) -> None:
        if self._bus is not None:
            self._to_close.append(self._bus)
        self._bus = None

    def listen(self, can_id: int, listener: Listener) -> None:
        """Pass every frame with this ID to `listener`; frames without a listener are ignored.

        Raises:
            DriverError: the ID has a listener already.
        """
        if can_id in self._listeners:
            raise DriverError(f"{self.what}: ID 0x{can_id:03X} is used by two devices")
        self._listeners[can_id] = listener

    def send(self, can_id: int, data: bytes) -> None:
        """Send a frame; raises LinkError."""
        if self._bus is None:
            raise LinkError(f"{self.what}: not open")
        try:
            self._bus.send(can_id, data)
        except Exception as error:  # noqa: BLE001 - as above
            self._fail(f"sending failed: {can_problem(self._config, error)}")

    def receive(self, deadline_s: float) -> bool:
        """Dispatch the next frame, waiting until `deadline_s` (perf_counter); 0 does not wait.

        Returns whether a frame was received; raises LinkError, also if the controller is bus-off.
        """
        if self._bus is None:
            raise LinkError(f"{self.what}: not open")
        try:
            wait_s = deadline_s - perf_counter() if deadline_s else 0.0
            frame = self._bus.receive(max(wait_s, 0.0))
        except BusOffError:
            self._fail(f"the controller is bus-off: {BUS_OFF}")
        except Exception as error:  # noqa: BLE001 - as above
            self._fail(f"receiving failed: {can_problem(self._config, error)}")
        if frame is None:
            return False
        can_id, data, stamp_s = frame
        age_s = self._ages.of(stamp_s)
        self._stamped = age_s is not None
        self.received_s = perf_counter() - (age_s or 0.0)
        listener = self._listeners.get(can_id)
        if listener is not None:
            listener(can_id, data)
        return True

    def drain(self) -> None:
        """Dispatch all frames received before this call; raises LinkError.

        Later frames stay in the queue: a busy bus never runs empty.
        """
        began_s = perf_counter()
        for _ in range(_MOST_FRAMES):
            if not self.receive(0.0) or (self._stamped and self.received_s > began_s):
                return

    @property
    def remedy(self) -> str:
        """What to do if no device answers a request."""
        return no_can_answer(self._config)

    def _fail(self, why: str) -> NoReturn:
        # Close later: shutting down waits, and other buses still need zero force in this cycle.
        self._close_later()
        raise LinkError(f"{self.what}: lost: {why}") from None
