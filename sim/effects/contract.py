"""The contract of effects: what the plant tells them, and what it asks them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ...config.base import ConfigError
from ..plant_kernels import Array

HOOKS = ("reset", "coil_force", "wrench", "mass", "beam_force", "gap")
"""Names of the methods, in the order in which they are called; see the package's docstring."""


class EffectError(ConfigError):
    """An effect that cannot be loaded, or that returned what it must not."""


@dataclass(frozen=True)
class BeamState:
    """True motion of beam and rotor."""

    x_m: float
    v_m_s: float
    a_m_s2: float
    phi_rad: float
    phi_rad_s: float
    phi_rad_s2: float


@dataclass(frozen=True)
class EffectGeometry:
    """Nominal arm, positions of coils (C,) and sensors (S,), height of the beam over O; m."""

    r_m: float
    coil_x_m: Array
    coil_y_m: Array
    beam_z_m: float
    sensor_x_m: Array
    sensor_y_m: Array


@dataclass(frozen=True)
class EffectPlant:
    """What `reset` gets: the internal step, a random generator for this effect, the geometry."""

    dt_s: float
    rng: np.random.Generator
    geometry: EffectGeometry
