"""Types that effects exchange with the plant: hooks, plant data, beam state, error."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ...config.base import ConfigError
from ..plant_kernels import Array

HOOKS = ("reset", "coil_force", "wrench", "mass", "beam_force", "gap")
"""Names of the hooks in the order of calls; see the package's docstring."""


class EffectError(ConfigError):
    """An effect cannot be loaded, fails, or returns an invalid result."""


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
    """Nominal arm, positions of coils (C,) and sensors (S,), height of the beam over O, in m."""

    r_m: float
    coil_x_m: Array
    coil_y_m: Array
    beam_z_m: float
    sensor_x_m: Array
    sensor_y_m: Array


@dataclass(frozen=True)
class EffectPlant:
    """Argument of `reset`: internal step, random generator of this effect, geometry."""

    dt_s: float
    rng: np.random.Generator
    geometry: EffectGeometry
