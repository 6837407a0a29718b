"""The readings of one device in a cycle: its frames gathered, by the deadline, or counted stale."""

from __future__ import annotations

from ...wire.can.can_frames import ValueFrames
from ...wire.frame_rejection import Rejected
from ..base import Array
from ..stale_readings import Watch
from .bus_link import CanLink


class Readings:
    """What comes in `frames` on `link`; `fresh` says whether it is of the cycle at hand."""

    def __init__(self, what: str, link: CanLink, frames: ValueFrames, stale_cycles: int) -> None:
        self.what = f"{what} on {link.what}"
        self.watch = Watch(self.what, stale_cycles)
        self.fresh = False
        self._link, self._frames = link, frames
        self._cycle = 0
        self._came_s = 0.0
        self._collected = True
        for can_id in frames.ids:
            link.listen(can_id, self._take)

    @property
    def states(self) -> tuple[int, ...]:
        """The device's state, as each of its last frames says."""
        return self._frames.states

    def begin(self, cycle: int) -> None:
        """Begin a cycle; what comes from here on must carry its counter."""
        self.watch.begin()
        self._frames.begin()
        self._cycle = cycle
        self._collected, self.fresh = False, False

    def collect(self, deadline_s: float, out: Array) -> None:
        """Wait for this cycle's frames and fill `out`; it stays as it was where they are stale.

        Raises:
            StaleError: too many cycles in a row were not clean.
        """
        if self._collected:
            return
        late = False
        try:
            # On a bus that is busy with other things there is always one more.
            while not (self._frames.complete or late) and self._link.receive(deadline_s):
                late = self._link.received_s > deadline_s
        finally:
            self._collected = True
        # What came while another device of this bus was waited for has been taken already.
        late = late or self._came_s > deadline_s
        if late:  # nobody knows when it was sampled
            if self._frames.begun:
                self.watch.late()
        elif self._frames.complete:
            wrong = self._frames.finish(out)
            if wrong is None:
                self.fresh = True
                self.watch.fresh()
                return
            # Its counter is right; but after so many missed cycles it may be one of sixteen ago.
            self.watch.reject(wrong, self._frames.behind)
        self.watch.missing()

    def reset(self) -> None:
        """Begin anew after a fault."""
        self.watch.reset()
        self._collected = True

    def _take(self, can_id: int, data: bytes) -> None:
        reason = self._frames.accept(can_id, data, self._cycle)
        if reason is None:
            # This process may look late at what came in time, and the other way round.
            self._came_s = self._link.received_s
            return
        late = reason is Rejected.COUNTER
        behind = self._frames.age(can_id, data, self._cycle) if late else 0
        self.watch.reject(reason, behind)
