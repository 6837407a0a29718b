"""Collect the frames of a device's reading in a cycle until the deadline, else mark it stale."""

from __future__ import annotations

from ...wire.can.can_frames import ValueFrames
from ...wire.frame_rejection_reasons import Rejected
from ..base import Array
from ..stale_readings import Watch
from .bus_link import CanLink


class Readings:
    """Readings of one device; `fresh` if they are of this cycle."""

    def __init__(self, what: str, link: CanLink, frames: ValueFrames, stale_cycles: int) -> None:
        self.what = f"{what} on {link.what}"
        self.watch = Watch(self.what, stale_cycles)
        self.fresh = False
        self._link, self._frames = link, frames
        self._cycle = 0
        self._arrived_s = 0.0
        self._collected = True
        for can_id in frames.ids:
            link.listen(can_id, self._handle_frame)

    @property
    def states(self) -> tuple[int, ...]:
        """State of the device in each of its last frames."""
        return self._frames.states

    def begin(self, cycle: int) -> None:
        """Begin a cycle; frames from now on have to carry its counter."""
        self.watch.begin()
        self._frames.begin()
        self._cycle = cycle
        self._collected, self.fresh = False, False

    def collect(self, deadline_s: float, out: Array) -> None:
        """Wait for this cycle's frames and fill `out`, which is unchanged if they are stale.

        Raises:
            StaleError: too many consecutive cycles were not clean.
            LinkError: the bus is lost.
        """
        if self._collected:
            return
        late = False
        try:
            # A bus that is busy with other frames never runs empty: stop at the deadline.
            while not (self._frames.complete or late) and self._link.receive(deadline_s):
                late = self._link.received_s > deadline_s
        finally:
            self._collected = True
        # Frames may have been dispatched while another device on this bus was awaited.
        late = late or self._arrived_s > deadline_s
        if late:  # the time of sampling is unknown
            if self._frames.begun:
                self.watch.late()
        elif self._frames.complete:
            wrong = self._frames.finish(out)
            if wrong is None:
                self.fresh = True
                self.watch.fresh()
                return
            # The 4-bit counter matches, but the frame may be 16 cycles old.
            self.watch.reject(wrong, self._frames.behind)
        self.watch.missing()

    def reset(self) -> None:
        """Start again after a fault."""
        self.watch.reset()
        self._collected = True

    def _handle_frame(self, can_id: int, data: bytes) -> None:
        reason = self._frames.accept(can_id, data, self._cycle)
        if reason is None:
            # The time of arrival, not the time at which this process reads the frame.
            self._arrived_s = self._link.received_s
            return
        late = reason is Rejected.COUNTER
        behind = self._frames.age(can_id, data, self._cycle) if late else 0
        self.watch.reject(reason, behind)
