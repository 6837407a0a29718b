"""Hold the readings of single sensors, from which a record's outputs were computed."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class SensorReadings:
    """Readings (N, S) in m of sensors at places (S, 2) in m, and the places (C, 2) of the coils.

    `rigid` (S, n): readings of a unit of each output, `forces` (C, p): wrench of a unit of force of
    each coil.
    """

    readings: NDArray[np.float32]
    sensors_m: Array
    coils_m: Array
    rigid: Array
    forces: Array

    def rows(self, cut: slice) -> SensorReadings:
        """Return some of the rows."""
        return replace(self, readings=self.readings[cut])
