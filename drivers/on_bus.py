"""What backends on any bus have in common: their roles, and what is stale when a cycle begins."""

from __future__ import annotations

from ..wire.budget import LONGEST_WAIT, budget
from .base import Backend, CoilAmplifiers, Context, ManipulatorDrives, PositionSensors

_ANSWER_SHARE = 0.5
"""Share of the period for which answers are waited for where the wire is quick: what is not there
by then is stale, and there is time left for control, setpoints and a late wake-up."""
_WIRE_MARGIN = 0.15


def answer_wait_s(context: Context) -> float:
    """Return how long after a cycle's begin answers count: longer where the wire takes longer."""
    needed_s = max(
        (
            bus.before_s + bus.answers_s + bus.latency_s
            for bus in budget(context.rig, context.folder).buses
        ),
        default=0.0,
    )
    share = min(needed_s / context.period_s + _WIRE_MARGIN, LONGEST_WAIT)
    return max(_ANSWER_SHARE, share) * context.period_s


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
