"""Find readings that stand still while the commanded force changes, where noise cannot tell.

Where the noise is below the sensor's step, readings of a platform at rest repeat for ever, so this
rule judges in the air by the wrench w that control and excitation add to the planned force. It
compares means over blocks in which a reading stood. A platform with stiffness K and mass M whose
mean wrench changed by dw for the time W has moved by about (K + M / W^2)^-1 dw: by more where it is
softer or lighter. If that is `STEPS` steps of the sensor and the reading has not changed, mass and
stiffness would have to be that much larger than declared.

A disturbance may take up the force instead: `DISTURBANCE_PER_S` of the weight in a second is
allowed, for warming coils or a load that creeps. While beam or rotor move, nothing is concluded:
the planned force need not fit their masses. Means over a block are weighted by a triangle, so that
an excitation beyond 1 / W leaves them as the platform's mass leaves its motion: as 1 / f^2.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from ...config.model import ModelConfig
from ...config.rig import RigConfig
from ...identification.greybox.declared_model_from_config import declared_model
from ...model.geometry import shape_matrix
from .feed_forward import feed_forward

Array = NDArray[np.float64]

STEPS = 10.0
"""Motion in steps of the sensor that the force must cause: ten times the least that changes a
reading, so mass and stiffness may be declared ten times too small."""
DISTURBANCE_PER_S = 1e-3
"""Change of the disturbance that is no fault, in weights a second, at the rim of the platform."""
BLOCK_S = 0.5
"""Length of a block; W is half of it."""

# Scalars: cycles of a block, cycle in the block, whether the block counts; sums (3,); the number of
# the sensor that stands still although it should move, plus one.
_CYCLES, _CYCLE, _COUNTS, _SUM, FORCE_FOUND = 0, 1, 2, 3, 6
FORCE_HEAD = 7
# Of each sensor: motion per wrench (3,), motion by the allowed disturbance in a block; the mean
# wrench of the first block in which its reading stood (3,), and blocks since then.
_MOTION, _DISTURBANCE, _FIRST, _BLOCKS = 0, 3, 4, 7
FORCE_SENSOR = 8


@dataclass(frozen=True)
class RigidBody:
    """How a force moves the platform at rest.

    inertia and stiffness (3, 3): of psi, theta, z in SI units. weight_n: the force that carries it.
    """

    inertia: Array
    stiffness: Array
    weight_n: float

    @classmethod
    def of(cls, rig: RigConfig, period_s: float) -> RigidBody:
        """Return the declared platform of a rig; raises ConfigError, see feed_forward."""
        law = feed_forward(rig, period_s)
        if isinstance(rig.model, ModelConfig):
            at = declared_model(rig.model).at()
            inertia = np.asarray(np.linalg.solve(at.B, at.M), np.float64)
            return cls(inertia, law.by_model[:, 1:4], float(abs(law.by_model[2, 0])))
        own = rig.feedforward
        assert own is not None
        # Only height is declared: mass and rods as if they were at the coils.
        arms = shape_matrix(rig.geometry.coil_x_m, rig.geometry.coil_y_m)
        spread = np.diag(np.mean(arms**2, axis=0))
        return cls(own.mass_kg * spread, own.rods_n_m * spread, law.weight_n)

    @property
    def motion_per_wrench(self) -> Array:
        """Least motion (3, 3) of psi, theta, z per wrench that lasts for half a block."""
        # A negative stiffness, as of magnets, may make the motion larger only.
        _, singular, vt = np.linalg.svd(self.stiffness)
        stiffness = vt.T * singular @ vt
        return np.asarray(np.linalg.inv(stiffness + self.inertia / (0.5 * BLOCK_S) ** 2))


class ForceRule:
    """Set up the rule for S sensors.

    Args:
        rig: geometry and declared platform.
        period_s: cycle period in s.
        head: FORCE_HEAD numbers, and sensors (S, FORCE_SENSOR): parts of the controller's memory.
    """

    def __init__(self, rig: RigConfig, period_s: float, head: Array, sensors: Array) -> None:
        shape = shape_matrix(rig.geometry.sensors_x_m, rig.geometry.sensors_y_m)
        body = RigidBody.of(rig, period_s)
        motion = shape @ body.motion_per_wrench
        arm_m = np.abs(shape[:, :2]).max(axis=0)
        wrench = DISTURBANCE_PER_S * BLOCK_S * body.weight_n * np.array([*arm_m, 1.0])
        self._head, self._sensors = head, sensors
        head[_CYCLES] = max(round(BLOCK_S / period_s), 4)
        sensors[:, _MOTION : _MOTION + 3] = motion
        sensors[:, _DISTURBANCE] = np.abs(motion) @ np.abs(wrench)
        self.begin()

    def begin(self) -> None:
        """Begin a block; forget earlier ones."""
        self._head[_CYCLE:] = 0.0
        self._head[_COUNTS] = 1.0
        self._sensors[:, _BLOCKS] = 0.0


def least_force_n(rig: RigConfig, period_s: float, step_m: float) -> float:
    """Return the change of the lift force in N that must move readings with this step."""
    motion = RigidBody.of(rig, period_s).motion_per_wrench
    return float(STEPS * step_m / abs(motion[2, 2]))


@njit(cache=True)
def note_force(  # type: ignore[no-untyped-def]
    coil, coil_shape, planned, share, steady, head, sensors, repeats, steps
) -> None:
    """Add the wrench of a cycle's coil forces (C,) to the block; judge the readings at its end.

    coil_shape (C, 3): the wrench is coil_shape^T coil. `planned` (3,) times `share` of it is the
    feed-forward. `steady`: in the air, with the manipulator at rest. repeats (S,): cycles for which
    each reading stands. steps (S,): in m.
    """
    cycles = head[_CYCLES]
    head[_CYCLE] += 1.0
    at = head[_CYCLE]
    weight = min(at, cycles + 1.0 - at)
    for i in range(3):
        wrench = -share * planned[i]
        for j in range(coil.size):
            wrench += coil_shape[j, i] * coil[j]
        head[_SUM + i] += weight * wrench
    if not steady:
        head[_COUNTS] = 0.0
    if at < cycles:
        return
    half = cycles // 2
    weights = (half + 1.0) * (half + cycles % 2)
    for j in range(len(sensors)):
        own = sensors[j]
        if head[_COUNTS] == 0.0 or repeats[j] < cycles:
            own[_BLOCKS] = 0.0
            continue
        own[_BLOCKS] += 1.0
        moved = 0.0
        for i in range(3):
            mean = head[_SUM + i] / weights
            if own[_BLOCKS] == 1.0:
                own[_FIRST + i] = mean
            moved += own[_MOTION + i] * (mean - own[_FIRST + i])
        if abs(moved) > STEPS * steps[j] + own[_DISTURBANCE] * (own[_BLOCKS] - 1.0):
            head[FORCE_FOUND] = j + 1.0
    head[_CYCLE], head[_COUNTS] = 0.0, 1.0
    head[_SUM] = head[_SUM + 1] = head[_SUM + 2] = 0.0
