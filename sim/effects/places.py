"""Base class and helpers of effects: force on a DOF, selection of coils and sensors, checks."""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import NDArray

from ..plant_kernels import Array
from .effect_interface import BeamState, EffectGeometry, EffectPlant

DOF = ("psi", "theta", "z")
Dof = Literal["psi", "theta", "z"]
Channel = int | Literal["all"]
Indices = NDArray[np.intp]


class OnDof:
    """A force on the platform along one DOF: vertical at its edge for a tilt, at its middle for z.

    With the arm a = r for psi and theta, 1 for z, the motion is s = a q, v = a q', and the wrench
    a F: a force of 1 N is a torque of r, a stiffness of 1 N/m one of r^2 N m/rad. Subclasses define
    F = `force(s, v)`. s leads by half a step because F is held over the step; without the lead a
    spring would be a negative damper.

    Raises:
        ValueError: the DOF is unknown.
    """

    def __init__(self, dof: Dof) -> None:
        if dof not in DOF:
            raise ValueError(f"dof: expected one of {', '.join(DOF)}, found {dof!r}")
        self._row = DOF.index(dof)

    def reset(self, plant: EffectPlant) -> None:
        """Store the step and the arm."""
        self._dt_s = plant.dt_s
        self._arm_m = 1.0 if self._row == 2 else plant.geometry.r_m

    def wrench(self, t_s: float, q: Array, qd: Array, beam: BeamState) -> list[float]:
        """Return the wrench of F on its DOF in N m, N m, N."""
        v = self._arm_m * float(qd[self._row])
        s = self._arm_m * float(q[self._row]) + 0.5 * self._dt_s * v
        tau = [0.0, 0.0, 0.0]
        tau[self._row] = self._arm_m * self.force(s, v)
        return tau

    def force(self, s: float, v: float) -> float:
        """Return F in N at s in m and v in m/s."""
        raise NotImplementedError


def positive(**values: float) -> None:
    """Raise ValueError for the first of `values` that is not positive."""
    for key, value in values.items():
        if not value > 0:
            raise ValueError(f"{key}: expected a number above 0, found {value!r}")


def chosen(channel: Channel, count: int, key: str) -> Indices:
    """Return the indices of a channel, one or all, out of `count` coils or sensors.

    Raises:
        ValueError: there is no such channel; the message names `key`.
    """
    if channel == "all":
        return np.arange(count)
    whole = isinstance(channel, int) and not isinstance(channel, bool)
    if not (whole and 0 <= channel < count):
        raise ValueError(f"{key}: expected 0 .. {count - 1} or all, found {channel!r}")
    return np.array([channel])


def coil_shapes(geometry: EffectGeometry) -> Array:
    """Return S (C, 3): S q are the coils' heights, S^T F is the wrench of their forces."""
    x, y = geometry.coil_x_m, geometry.coil_y_m
    return np.stack([y, x, np.ones_like(x)], axis=1)
