"""Find what a session asks of a rig that its model says it cannot do: motion and heat of the coils.

Limits of single positions, speeds and forces are checked when the session is planned.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np
from numpy.typing import NDArray

from ...config.rig import RigConfig
from ...config.session import SessionConfig
from ...model.geometry import decoupling_matrix
from ..control.feed_forward import feed_forward
from .plan import Plan, Progress
from .predicted_motion import motion_within_limits, predicted_motion
from .rig_plausibility import Problem

Array = NDArray[np.float64]


_G_M_S2 = 9.81
_SMOOTH_ACCELERATION = 5.774
"""Largest acceleration of a smooth step of length 1 in a time of 1."""
_LONGEST_RAMP_S = 60.0
_RAMPS = ("unload_s", "ramp_s", "release_s")


def session_problems(
    session: SessionConfig, rig: RigConfig, plan: Plan, report: Progress = lambda _, __: None
) -> list[Problem]:
    """Return why a session cannot be flown on a rig, or is unusual, errors first.

    `plan` is the session's plan. The predicted motion and heat are compared with the rig's limits.

    `report` is that of plan_session; it is called for the motion. Without a model the motion is
    unknown.

    Raises:
        ConfigError: the model does not fit the rig.
    """
    predicted = predicted_motion(rig, plan, report)
    motion = motion_within_limits(rig, predicted)
    found = [*_ramps(session, rig), *_short_records(session)]
    if motion.failed:
        found.append(Problem("steps", f"{motion.found}: {motion.remedy}", fatal=True))
    if predicted is not None and rig.limits.coil_rms_n is not None:
        found += _heat(rig, plan, predicted.excitation_n2, rig.limits.coil_rms_n)
    return sorted(found, key=lambda problem: not problem.fatal)


def _ramps(session: SessionConfig, rig: RigConfig) -> Iterator[Problem]:
    """Compare the times of lift-off and landing with the forces that they need."""
    limits = rig.limits
    law = feed_forward(rig, 1.0 / rig.rate_hz)
    T = decoupling_matrix(rig.geometry.coil_x_m, rig.geometry.coil_y_m)
    weight = law.wrench(np.zeros((1, 3)))
    spare = limits.coil_n / max(float(np.abs(weight @ T).max()), 1e-9)
    # All coils together accelerate the platform with what they can give beyond its weight.
    up_m_s2 = _G_M_S2 * max(spare - 1.0, 1e-9)
    least = {
        "levitate": float(np.sqrt(_SMOOTH_ACCELERATION * limits.gap_m / up_m_s2)),
        # A platform falls no faster than its weight accelerates it.
        "land": float(np.sqrt(_SMOOTH_ACCELERATION * limits.gap_m / _G_M_S2)),
    }
    for number, step in enumerate(session.steps):
        ramped = step.levitate or step.land
        if ramped is None:
            continue
        key = f"steps[{number}].{step.kind}"
        if ramped.ramp_s < least[step.kind]:
            yield Problem(
                f"{key}.ramp_s",
                f"expected {least[step.kind]:.2g} s or more, in which the coils can move the "
                f"platform by gap_m, found {ramped.ramp_s:g} s",
                fatal=step.kind == "levitate",
            )
        for name in _RAMPS:
            value = getattr(ramped, name, 0.0)
            if value > _LONGEST_RAMP_S:
                yield Problem(
                    f"{key}.{name}",
                    f"found {value:g} s, usually at most {_LONGEST_RAMP_S:g} s; is it in s?",
                )


def _short_records(session: SessionConfig) -> Iterator[Problem]:
    """Find records that are shorter than a period of their multisine."""
    for number, step in enumerate(session.steps):
        record = step.record
        length_s = None if record is None else record.each_s or record.duration_s
        if record is None or length_s is None:
            continue
        for name in record.excite:
            period_s = session.excitations[name].period_s
            if period_s is not None and length_s < period_s:
                yield Problem(
                    f"steps[{number}].record",
                    f"lasts {length_s:g} s, less than one period of '{name}', {period_s:g} s; "
                    "expected whole periods",
                )


def _heat(
    rig: RigConfig, plan: Plan, excitation_n2: Mapping[str, Array], limit_n: float
) -> list[Problem]:
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
            text = (
                f"coil {coil} reaches {np.sqrt(heat[coil]):.3g} N RMS in record {step.name} with "
                f"weight and excitation, expected at most limits.coil_rms_n, {limit_n:g} N: lower "
                "the level of the excitation"
            )
            return [Problem(f"steps[{step.index}].record", text, fatal=True)]
    return []
