"""Mains interference: a sum of harmonics as a force or in sensor readings."""

from __future__ import annotations

import math
from collections.abc import Sequence

from ..plant_kernels import Array
from .effect_interface import BeamState
from .places import Channel, Dof, OnDof
from .sensors import OnSensors


class Hum:
    """Sum of a_k sin(2 pi k f t), k = 1, 2, ..., with the `amplitudes` a_k."""

    def __init__(self, amplitudes: Sequence[float], freq_hz: float) -> None:
        if not amplitudes:
            raise ValueError("amplitudes: expected one or more, that of freq_hz first, found none")
        self._parts = [(a, 2.0 * math.pi * k * freq_hz) for k, a in enumerate(amplitudes, 1) if a]

    def at(self, t_s: float) -> float:
        """Return the value at t_s."""
        return sum(a * math.sin(w * t_s) for a, w in self._parts)


class MainsForce(OnDof):
    """A hum as a force on one DOF (see OnDof): force of stray fields on the platform."""

    def __init__(self, dof: Dof, amplitudes_n: Sequence[float], freq_hz: float = 50.0) -> None:
        super().__init__(dof)
        self._hum = Hum(amplitudes_n, freq_hz)

    def wrench(self, t_s: float, q: Array, qd: Array, beam: BeamState) -> list[float]:
        """Return the wrench at the step's middle in N m, N m, N."""
        tau = [0.0, 0.0, 0.0]
        tau[self._row] = self._arm_m * self._hum.at(t_s + 0.5 * self._dt_s)
        return tau


class MainsPickup(OnSensors):
    """A hum in the readings of one sensor or all: pick-up on its cable."""

    def __init__(
        self, sensor: Channel, amplitudes_m: Sequence[float], freq_hz: float = 50.0
    ) -> None:
        super().__init__(sensor)
        self._hum = Hum(amplitudes_m, freq_hz)

    def measured(self, t_s: float, gap_m: Array) -> Array:
        """Return the measured gaps in m."""
        return gap_m + self._hum.at(t_s)
