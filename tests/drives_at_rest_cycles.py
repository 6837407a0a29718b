"""Drives that stand still on a bus, cycle by cycle."""

from __future__ import annotations

import numpy as np

from levid.config.rig import RigConfig
from levid.drivers.base import Devices


def with_drives(rig: RigConfig, **options: object) -> RigConfig:
    """The rig with other options of its drives."""
    role = rig.drives.model_validate({**rig.drives.model_dump(), **options})
    return rig.model_copy(update={"drives": role})


def run(devices: Devices, cycles: range) -> None:
    """Read everything and write setpoints of zero; these go out even where reading fails."""
    beam, rotor, gap, coil = np.zeros(3), np.zeros(3), np.zeros(9), np.zeros(9)
    for k in cycles:
        for sync in devices.syncs:
            sync(k)
        devices.sensors.read(gap)
        devices.amplifiers.read(coil)
        try:
            devices.drives.read(beam, rotor)
        finally:
            devices.drives.write(np.zeros(3), np.zeros(3))
