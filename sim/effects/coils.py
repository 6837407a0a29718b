"""Static errors of coil forces: gain, height dependence, dead zone, offset, saturation."""

from __future__ import annotations

import numpy as np

from ..plant_kernels import Array
from .effect_interface import EffectPlant
from .places import Channel, chosen, coil_shapes, positive


class OnCoils:
    """Base of an effect on one coil or on all; subclasses define the delivered force.

    Raises:
        ValueError: (in `reset`) the rig has no such coil.
    """

    def __init__(self, coil: Channel) -> None:
        self.coil = coil

    def reset(self, plant: EffectPlant) -> None:
        """Select the coils."""
        self._at = chosen(self.coil, len(plant.geometry.coil_x_m), "coil")
        self._dt_s = plant.dt_s

    def coil_force(self, t_s: float, q: Array, force_n: Array) -> Array:
        """Return the true coil forces in N."""
        force_n[self._at] = self.delivered(force_n[self._at])
        return force_n

    def delivered(self, force_n: Array) -> Array:
        """Return the delivered forces in N of the affected coils for the driven `force_n`."""
        raise NotImplementedError


class CoilGain(OnCoils):
    """F = (1 + excess) F: windings or magnets differ from the nominal ones."""

    def __init__(self, coil: Channel, excess: float) -> None:
        super().__init__(coil)
        self.excess = excess

    def delivered(self, force_n: Array) -> Array:
        """Return the delivered forces in N."""
        return (1.0 + self.excess) * force_n


class ForceConstant(OnCoils):
    """F = (1 + a h + b h^2) F at the coil's height h: the magnetic field is not uniform.

    A coil in the middle of its magnet has a = 0 and b < 0; one that is too high has a < 0.
    """

    def __init__(self, coil: Channel, slope_1_m: float, curve_1_m2: float = 0.0) -> None:
        super().__init__(coil)
        self.slope_1_m, self.curve_1_m2 = slope_1_m, curve_1_m2

    def reset(self, plant: EffectPlant) -> None:
        """Select the coils and store their positions."""
        super().reset(plant)
        self._shapes = coil_shapes(plant.geometry)[self._at]

    def coil_force(self, t_s: float, q: Array, force_n: Array) -> Array:
        """Return the true coil forces in N."""
        h = self._shapes @ q
        force_n[self._at] *= 1.0 + h * (self.slope_1_m + self.curve_1_m2 * h)
        return force_n


class DeadZone(OnCoils):
    """F = sgn(F) max(|F| - w, 0): crossover of an amplifier's output stage at zero current.

    The command of a coil that carries weight reaches the dead zone only at high excitation;
    otherwise w is an offset.
    """

    def __init__(self, coil: Channel, width_n: float) -> None:
        super().__init__(coil)
        self.width_n = width_n

    def delivered(self, force_n: Array) -> Array:
        """Return the delivered forces in N."""
        return np.asarray(force_n - np.clip(force_n, -self.width_n, self.width_n))


class ForceOffset(OnCoils):
    """F = F + F_0: offset of an amplifier, or pull of a magnet."""

    def __init__(self, coil: Channel, offset_n: float) -> None:
        super().__init__(coil)
        self.offset_n = offset_n

    def delivered(self, force_n: Array) -> Array:
        """Return the delivered forces in N."""
        return force_n + self.offset_n


class SoftSaturation(OnCoils):
    """F = F / (1 + |F / L|^p)^(1/p): magnetic saturation with the limit L.

    p is the sharpness of the knee; p = 1 is Fröhlich's equation (1881).
    """

    def __init__(self, coil: Channel, limit_n: float, sharpness: float) -> None:
        super().__init__(coil)
        positive(limit_n=limit_n, sharpness=sharpness)
        self.limit_n, self.sharpness = limit_n, sharpness

    def delivered(self, force_n: Array) -> Array:
        """Return the delivered forces in N."""
        # Logarithms avoid the overflow of a large ratio to a high power.
        share = np.log(np.maximum(np.abs(force_n) / self.limit_n, 1e-300))
        less = np.logaddexp(0.0, self.sharpness * share) / self.sharpness
        return np.asarray(force_n * np.exp(-less))
