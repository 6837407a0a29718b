"""Base class of bus backends, and the deadline until which a cycle waits for answers."""

from __future__ import annotations

from math import inf
from typing import NamedTuple

from ..wire.bus_budget import LONGEST_WAIT, budget
from .base import Backend, CoilAmplifiers, Context, ManipulatorDrives, PositionSensors

_ANSWER_SHARE = 0.5
"""Share of the period in which answers are awaited on a fast bus. Later answers are stale: the rest
of the period is for control, setpoints and a late wake-up."""
_WIRE_MARGIN = 0.15
_SETPOINTS_SHARE = 0.97
"""Share of the period by which setpoints are sent: after the next SYNC they act a cycle late."""


class AnswerTime(NamedTuple):
    """Deadline of answers: `wait_s` after SYNC, and `latest_s` after the cycle was due."""

    wait_s: float
    latest_s: float = inf

    @classmethod
    def of(cls, context: Context) -> AnswerTime:
        """Return the deadline of a rig, from its bus budget.

        After a missing reading there is still time to send the setpoints of the same cycle.
        """
        buses = budget(context.rig, context.folder).buses
        needed = max((bus.answered_s for bus in buses), default=0.0) / context.period_s
        sending = max((bus.setpoints_s for bus in buses), default=0.0) / context.period_s
        latest = max(_SETPOINTS_SHARE - sending, needed)
        share = max(_ANSWER_SHARE, min(needed + _WIRE_MARGIN, LONGEST_WAIT))
        return cls(min(share, latest) * context.period_s, latest * context.period_s)

    def deadline_s(self, now_s: float, late_s: float) -> float:
        """Return the deadline of a cycle that begins at `now_s`, `late_s` late."""
        return now_s + max(min(self.wait_s, self.latest_s - late_s), 0.0)


class BusBackend(Backend):
    """A backend whose roles are in `_roles`, by their names in RIG.yaml."""

    _roles: dict[str, CoilAmplifiers | PositionSensors | ManipulatorDrives]

    def amplifiers(self) -> CoilAmplifiers:
        """Return the amplifiers; raises DriverError if this backend has none."""
        found = self._roles.get("amplifiers")
        return found if isinstance(found, CoilAmplifiers) else super().amplifiers()

    def sensors(self) -> PositionSensors:
        """Return the sensors; raises DriverError if this backend has none."""
        found = self._roles.get("sensors")
        return found if isinstance(found, PositionSensors) else super().sensors()

    def drives(self) -> ManipulatorDrives:
        """Return the drives; raises DriverError if this backend has none."""
        found = self._roles.get("drives")
        return found if isinstance(found, ManipulatorDrives) else super().drives()

    def _mark_stale(self) -> None:
        """Mark every reading as stale until the reading of this cycle arrives."""
        for role in self._roles.values():
            role.stale = role.STALE
