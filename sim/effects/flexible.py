"""Flexible mode of the platform, driven by the coils and measured by the sensors."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence

import numpy as np

from ..plant_kernels import Array
from .effect_interface import EffectPlant
from .places import positive

SHAPES: Mapping[str, Callable[[Array, Array], Array]] = {
    "twist": lambda x, y: x * y,
    "saddle": lambda x, y: x * x - y * y,
    "bowl": lambda x, y: x * x + y * y,
}
"""First modes of a free square plate over x / r and y / r; the bowl has zero mean."""


class FlexibleMode:
    """m (eta'' + 2 zeta w eta' + w^2 eta) = sum phi_i F_i; the gaps increase by psi_j eta.

    phi and psi are the mode shape at coils and sensors with the maximum 1: a name in SHAPES
    (Leissa, Vibration of Plates 1969) or a list of C numbers. `sensor_shape` gives psi; default: as
    phi. Modes are orthogonal to rigid-body motions, so the weight does not excite them. The
    integration is exact for a force held over the step.
    """

    def __init__(
        self,
        freq_hz: float,
        damping: float,
        mass_kg: float,
        shape: str | Sequence[float] = "twist",
        sensor_shape: Sequence[float] | None = None,
    ) -> None:
        positive(freq_hz=freq_hz, mass_kg=mass_kg, damping=damping)
        if damping >= 1.0:
            raise ValueError(f"damping: expected less than 1, found {damping!r}")
        if isinstance(shape, str) and shape not in SHAPES:
            raise ValueError(f"shape: expected one of {', '.join(SHAPES)}, found {shape!r}")
        self.freq_hz, self.damping, self.mass_kg = freq_hz, damping, mass_kg
        self.shape, self.sensor_shape = shape, sensor_shape

    def reset(self, plant: EffectPlant) -> None:
        """Start with the mode at rest; raises ValueError for a shape of the wrong length."""
        g = plant.geometry
        at_coils = _shape(self.shape, g.coil_x_m, g.coil_y_m, g.r_m, "shape")
        at_sensors = self.shape if self.sensor_shape is None else self.sensor_shape
        self._at_sensors = _shape(at_sensors, g.sensor_x_m, g.sensor_y_m, g.r_m, "sensor_shape")
        self._drive = at_coils / self.mass_kg
        w, dt = 2.0 * math.pi * self.freq_hz, plant.dt_s
        self._static = 1.0 / (w * w)
        decay, turn = self.damping * w, w * math.sqrt(1.0 - self.damping**2)
        fall, c, s = math.exp(-decay * dt), math.cos(turn * dt), math.sin(turn * dt) / turn
        # Transition matrix of eta and eta' over a step.
        self._step = (fall * (c + decay * s), fall * s, -fall * w * w * s, fall * (c - decay * s))
        self._eta, self._rate = 0.0, 0.0

    def coil_force(self, t_s: float, q: Array, force_n: Array) -> Array:
        """Advance the mode by a step; return the coil forces in N unchanged."""
        rest = float(self._drive @ force_n) * self._static
        away, rate = self._eta - rest, self._rate
        a, b, c, d = self._step
        self._eta, self._rate = rest + a * away + b * rate, c * away + d * rate
        return force_n

    def gap(self, t_s: float, gap_m: Array) -> Array:
        """Return the gaps plus the mode's deflection in m."""
        gap_m += self._at_sensors * self._eta
        return gap_m


def _shape(shape: str | Sequence[float], x_m: Array, y_m: Array, r_m: float, key: str) -> Array:
    """Return the mode shape at points (N,), with the maximum 1."""
    if isinstance(shape, str):
        values = SHAPES[shape](x_m / r_m, y_m / r_m)
        values = values - values.mean() if shape == "bowl" else values
        return np.asarray(values / np.abs(values).max())
    values = np.array(shape, dtype=np.float64)
    if values.shape != x_m.shape:
        raise ValueError(f"{key}: expected {len(x_m)} numbers, found {len(values)}")
    return values
