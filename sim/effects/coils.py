"""Coils that give another force than their amplifier drives, at once and without memory."""

from __future__ import annotations

import numpy as np

from ..plant_kernels import Array
from .contract import EffectPlant
from .places import Channel, chosen, coil_shapes, positive


class OnCoils:
    """What happens at one coil, or alike at all; subclasses say what they give.

    Raises ValueError in `reset` for a coil that the rig has not.
    """

    def __init__(self, coil: Channel) -> None:
        self.coil = coil

    def reset(self, plant: EffectPlant) -> None:
        """Look up which coils are meant."""
        self._at = chosen(self.coil, len(plant.geometry.coil_x_m), "coil")
        self._dt_s = plant.dt_s

    def coil_force(self, t_s: float, q: Array, force_n: Array) -> Array:
        """Return what the coils really give, N."""
        force_n[self._at] = self.given(force_n[self._at])
        return force_n

    def given(self, force_n: Array) -> Array:
        """Return what the coils at hand give for `force_n`, N."""
        raise NotImplementedError


class CoilGain(OnCoils):
    """F = (1 + excess) F: turns or magnets that differ from the nominal ones."""

    def __init__(self, coil: Channel, excess: float) -> None:
        super().__init__(coil)
        self.excess = excess

    def given(self, force_n: Array) -> Array:
        """Return what the coils at hand give, N."""
        return (1.0 + self.excess) * force_n


class ForceConstant(OnCoils):
    """F = (1 + a h + b h^2) F at the coil's height h: it leaves the even part of the field.

    A coil in the middle of its magnets has b < 0 alone; one that sits too high has a < 0.
    """

    def __init__(self, coil: Channel, slope_1_m: float, curve_1_m2: float = 0.0) -> None:
        super().__init__(coil)
        self.slope_1_m, self.curve_1_m2 = slope_1_m, curve_1_m2

    def reset(self, plant: EffectPlant) -> None:
        """Look up which coils are meant, and where they are."""
        super().reset(plant)
        self._shapes = coil_shapes(plant.geometry)[self._at]

    def coil_force(self, t_s: float, q: Array, force_n: Array) -> Array:
        """Return what the coils really give, N."""
        h = self._shapes @ q
        force_n[self._at] *= 1.0 + h * (self.slope_1_m + self.curve_1_m2 * h)
        return force_n


class DeadZone(OnCoils):
    """F = sgn(F) max(|F| - w, 0): crossover of an amplifier's output stage at zero current.

    A coil that carries weight never gets there unless it is driven hard: before, w is an offset.
    """

    def __init__(self, coil: Channel, width_n: float) -> None:
        super().__init__(coil)
        self.width_n = width_n

    def given(self, force_n: Array) -> Array:
        """Return what the coils at hand give, N."""
        return np.asarray(force_n - np.clip(force_n, -self.width_n, self.width_n))


class ForceOffset(OnCoils):
    """F = F + F_0: an amplifier's offset, or a magnet's pull."""

    def __init__(self, coil: Channel, offset_n: float) -> None:
        super().__init__(coil)
        self.offset_n = offset_n

    def given(self, force_n: Array) -> Array:
        """Return what the coils at hand give, N."""
        return force_n + self.offset_n


class SoftSaturation(OnCoils):
    """F = F / (1 + |F / L|^p)^(1/p): iron that saturates; it never gives more than L.

    p says how sharp the knee is. Fröhlich 1881 for p = 1.
    """

    def __init__(self, coil: Channel, limit_n: float, sharpness: float) -> None:
        super().__init__(coil)
        positive(limit_n=limit_n, sharpness=sharpness)
        self.limit_n, self.sharpness = limit_n, sharpness

    def given(self, force_n: Array) -> Array:
        """Return what the coils at hand give, N."""
        # In logarithms: a sharp knee's power of a force far beyond it is no number.
        share = np.log(np.maximum(np.abs(force_n) / self.limit_n, 1e-300))
        less = np.logaddexp(0.0, self.sharpness * share) / self.sharpness
        return np.asarray(force_n * np.exp(-less))
