"""What backends on any bus have in common: their roles, and what is stale when a cycle begins."""

from __future__ import annotations

from math import inf
from typing import NamedTuple

from ..wire.bus_budget import LONGEST_WAIT, budget
from .base import Backend, CoilAmplifiers, Context, ManipulatorDrives, PositionSensors

_ANSWER_SHARE = 0.5
"""Share of the period for which answers are waited for where the wire is quick: what is not there
by then is stale, and there is time left for control, setpoints and a late wake-up."""
_WIRE_MARGIN = 0.15
_SENT_BY = 0.97
"""Share of the period by which setpoints have left: behind the next SYNC they act a cycle late."""


class AnswerTime(NamedTuple):
    """How long answers count: `wait_s` after SYNC, and `latest_s` after the cycle was due."""

    wait_s: float
    latest_s: float = inf

    @classmethod
    def of(cls, context: Context) -> AnswerTime:
        """Return it for a rig: longer where the wire takes longer, and setpoints still to go out.

        A reading that is missing is not to cost the setpoints of its cycle as well.
        """
        buses = budget(context.rig, context.folder).buses
        needed = max((bus.answered_s for bus in buses), default=0.0) / context.period_s
        to_go = max((bus.setpoints_s for bus in buses), default=0.0) / context.period_s
        latest = max(_SENT_BY - to_go, needed)
        share = max(_ANSWER_SHARE, min(needed + _WIRE_MARGIN, LONGEST_WAIT))
        return cls(min(share, latest) * context.period_s, latest * context.period_s)

    def deadline_s(self, now_s: float, late_s: float) -> float:
        """Return until when answers count in a cycle that begins now, `late_s` late."""
        return now_s + max(min(self.wait_s, self.latest_s - late_s), 0.0)


class BusBackend(Backend):
    """A backend that plays the roles in `_roles`, by their names in the rig's YAML."""

    _roles: dict[str, CoilAmplifiers | PositionSensors | ManipulatorDrives]

    def amplifiers(self) -> CoilAmplifiers:
        """Return the amplifiers; raises DriverError where this backend has none."""
        found = self._roles.get("amplifiers")
        return found if isinstance(found, CoilAmplifiers) else super().amplifiers()

    def sensors(self) -> PositionSensors:
        """Return the sensors; raises DriverError where this backend has none."""
        found = self._roles.get("sensors")
        return found if isinstance(found, PositionSensors) else super().sensors()

    def drives(self) -> ManipulatorDrives:
        """Return the drives; raises DriverError where this backend has none."""
        found = self._roles.get("drives")
        return found if isinstance(found, ManipulatorDrives) else super().drives()

    def _nothing_came(self) -> None:
        """Mark every reading as an earlier cycle's, until that of this one comes."""
        for role in self._roles.values():
            role.stale = role.STALE
