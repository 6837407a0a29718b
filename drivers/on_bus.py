"""What backends on any bus have in common: their roles, and what is stale when a cycle begins."""

from __future__ import annotations

from .base import Backend, CoilAmplifiers, ManipulatorDrives, PositionSensors


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
