"""One CAN bus: sends frames, hands those that come to whoever listens, up to a deadline."""

from __future__ import annotations

from collections.abc import Callable
from time import perf_counter
from typing import NoReturn

from ...config.buses import CanBus
from ...wire.can.can_bus import Ages, FrameBus, open_bus
from ...wire.can.kernel_frame import BusOffError
from ..base import DriverError, LinkError
from ..bus_lock import Claim

_MOST_DRAINED = 1000
"""More frames than come between cycles; where frames have no stamp nothing else ends it."""

Listener = Callable[[int, bytes], None]


class CanLink:
    """A bus that may go away and come back; what fails is a LinkError that names bus and cause."""

    def __init__(self, name: str, bus: CanBus) -> None:
        self.what = f"can {name} ({bus.interface} {bus.channel})"
        self._config = bus
        self._listeners: dict[int, Listener] = {}
        self._bus: FrameBus | None = None
        self._aside: list[FrameBus] = []  # lost, and not shut down yet
        self._ages, self._stamped = Ages(bus.interface), False
        self.received_s = 0.0
        """When the last frame came, on the loop's clock (perf_counter), by the stamp of hardware or
        kernel where the interface gives one: it is free of the delays of this process."""
        # A virtual bus is of this process alone.
        self._claim = None if bus.interface == "virtual" else Claim(bus.place)

    def open(self) -> None:
        """Open the bus, anew if it was open; raises LinkError, where another loop has it too."""
        self._let_go()
        if self._claim is not None:
            self._claim.require(self.what)
        try:
            self._bus = open_bus(self._config)
        except Exception as error:  # noqa: BLE001 - interfaces raise whatever they meet
            raise LinkError(f"{self.what}: cannot be opened: {_words(error)}") from None

    def close(self) -> None:
        """Let go of the bus; safe to call twice."""
        self._let_go()
        if self._claim is not None:
            self._claim.release()

    def _let_go(self) -> None:
        self._set_aside()
        while self._aside:
            self._aside.pop().shutdown()

    def _set_aside(self) -> None:
        if self._bus is not None:
            self._aside.append(self._bus)
        self._bus = None

    def listen(self, can_id: int, listener: Listener) -> None:
        """Hand every frame of this ID to `listener`; frames of other IDs are nobody's.

        Raises:
            DriverError: somebody listens to it already, and would hear nothing any more.
        """
        if can_id in self._listeners:
            raise DriverError(f"{self.what}: ID 0x{can_id:03X} is used twice")
        self._listeners[can_id] = listener

    def send(self, can_id: int, data: bytes) -> None:
        """Send a frame; raises LinkError."""
        if self._bus is None:
            raise LinkError(f"{self.what}: gone")
        try:
            self._bus.send(can_id, data)
        except Exception as error:  # noqa: BLE001 - as above
            self._lost(f"sending failed: {_words(error)}")

    def receive(self, deadline_s: float) -> bool:
        """Hand on the next frame, waiting until `deadline_s` (perf_counter) at most.

        Returns whether one came; raises LinkError, for a controller that is bus-off too.
        """
        if self._bus is None:
            raise LinkError(f"{self.what}: gone")
        try:
            wait_s = deadline_s - perf_counter() if deadline_s else 0.0
            frame = self._bus.receive(max(wait_s, 0.0))
        except BusOffError:
            self._lost("the controller is bus-off")
        except Exception as error:  # noqa: BLE001 - as above
            self._lost(f"receiving failed: {_words(error)}")
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
        """Hand on all that has come; raises LinkError.

        What comes meanwhile is left: on a busy bus there is always one more.
        """
        began_s = perf_counter()
        for _ in range(_MOST_DRAINED):
            if not self.receive(0.0) or (self._stamped and self.received_s > began_s):
                return

    def _lost(self, why: str) -> NoReturn:
        # Shutting down waits, for a thread or a line: in the cycle at hand other buses have not had
        # their zero force yet.
        self._set_aside()
        raise LinkError(f"{self.what}: lost: {why}") from None


def _words(error: Exception) -> str:
    """Return what an error says; of python-can's for a time that is over there is its name only."""
    return str(error) or type(error).__name__
