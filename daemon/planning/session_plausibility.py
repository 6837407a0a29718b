"""Find what a session asks of a rig that its model says it cannot do: motion and heat of the coils.

Limits of single positions, speeds and forces are checked when the session is planned.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from ...config.rig import RigConfig
from ...model.geometry import decoupling_matrix
from ..control.feed_forward import feed_forward
from .plan import Plan, Progress
from .predicted_motion import motion_within_limits, predicted_motion

Array = NDArray[np.float64]


def session_problems(
    rig: RigConfig, plan: Plan, report: Progress = lambda _, __: None
) -> list[str]:
    """Return why a plan cannot be flown on a rig: predicted motion or heat beyond its limits.

    `report` is that of plan_session; it is called for the motion. Without a model the motion is
    unknown.

    Raises:
        ConfigError: the model does not fit the rig.
    """
    predicted = predicted_motion(rig, plan, report)
    motion = motion_within_limits(rig, predicted)
    found = [f"{motion.found}: {motion.remedy}"] if motion.failed else []
    if predicted is not None and rig.limits.coil_rms_n is not None:
        found += _heat(rig, plan, predicted.excitation_n2, rig.limits.coil_rms_n)
    return found


def _heat(
    rig: RigConfig, plan: Plan, excitation_n2: Mapping[str, Array], limit_n: float
) -> list[str]:
    """Return the first record whose weight and excitation heat a coil beyond its limit.

    The square of the force is filtered as in flight, with coil_time_constant_s. The record begins
    with the heat of the weight alone.
    """
    T = decoupling_matrix(rig.geometry.coil_x_m, rig.geometry.coil_y_m)
    law = feed_forward(rig, 1.0 / plan.rate_hz)
    for step in plan.steps:
        if step.excitation is None:
            continue
        carried = (law.wrench(np.array([[step.beam_m, 0.0, 0.0]])) @ T)[0]
        during_s = step.excitation.cycles / plan.rate_hz
        share = 1.0 - np.exp(-during_s / rig.limits.coil_time_constant_s)
        heat = np.square(carried) + share * excitation_n2[step.name]
        coil = int(np.argmax(heat))
        if heat[coil] > limit_n**2:
            return [
                f"coil {coil} reaches {np.sqrt(heat[coil]):.3g} N RMS in record {step.name} with "
                f"weight and excitation, expected at most limits.coil_rms_n, {limit_n:g} N: lower "
                "the level of the excitation"
            ]
    return []
