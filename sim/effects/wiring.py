"""Wrong wiring: channels of coils and sensors that are swapped, reversed, weak or dead."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..plant_kernels import Array
from .effect_interface import EffectPlant


class Wiring:
    """Connect channel i to the coil or sensor `order[i]`, with the factor `scale[i]`.

    A negative factor is a wrong polarity or sign, 0 a dead channel. Without a list all is as it is.

    Raises:
        ValueError: (in `reset`) a list has another length than the rig has channels, or an order
            does not name each of them once.
    """

    def __init__(
        self,
        coil_order: Sequence[int] | None = None,
        coil_scale: Sequence[float] | None = None,
        sensor_order: Sequence[int] | None = None,
        sensor_scale: Sequence[float] | None = None,
    ) -> None:
        self._given = {
            "coil": (coil_order, coil_scale),
            "sensor": (sensor_order, sensor_scale),
        }

    def reset(self, plant: EffectPlant) -> None:
        """Check the lists against the rig."""
        counts = {"coil": len(plant.geometry.coil_x_m), "sensor": len(plant.geometry.sensor_x_m)}
        self._order, self._scale = {}, {}
        for kind, (order, scale) in self._given.items():
            n = counts[kind]
            self._order[kind] = np.array(range(n) if order is None else order, int)
            self._scale[kind] = np.array([1.0] * n if scale is None else scale, float)
            if sorted(self._order[kind].tolist()) != list(range(n)):
                raise ValueError(f"{kind}_order: expected each of 0 to {n - 1} once, found {order}")
            if len(self._scale[kind]) != n:
                raise ValueError(
                    f"{kind}_scale: expected {n} numbers, found {len(self._scale[kind])}"
                )

    def coil_force(self, t_s: float, q: Array, force_n: Array) -> Array:
        """Return the true coil forces in N, by coil, for those of the channels."""
        true = np.empty_like(force_n)
        true[self._order["coil"]] = self._scale["coil"] * force_n
        return true

    def gap(self, t_s: float, gap_m: Array) -> Array:
        """Return the readings of the channels in m for the true heights."""
        return np.asarray(self._scale["sensor"] * gap_m[self._order["sensor"]])
