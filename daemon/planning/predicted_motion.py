"""Predict how far a plan moves the platform, with the declared model in its loop.

The model is linear, and limits of the forces do not count. The feed-forward holds the weight of
platform and beam exactly in it, so only two causes move it: the excitation, and a beam that the
feed-forward does not carry. A real plant differs from its declared model by 10 to 20 %.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from ...config.rig import RigConfig
from ...identification.subspace.simulation import Simulation
from ...model.controller import closed_loop, pi_controller
from ...model.geometry import decoupling_matrix, shape_matrix
from ...model.second_order import StateSpace
from ..control.feed_forward import feed_forward
from ..control.loop_stability import declared_plant
from ..control.preflight_findings import Check, Finding, Outcome
from .plan import Plan, PlannedStep, Progress

Array = NDArray[np.float64]

_ROWS = 1 << 14


@dataclass(frozen=True)
class PredictedMotion:
    """Largest height at a sensor in m and largest tilt in rad, and the step of each.

    excitation_n2: mean square of the excitation (C,) of each coil in N^2, by step. disturbed: the
    steps in which the feed-forward does not carry the moving beam.
    """

    gap_m: float
    gap_step: str
    tilt_rad: float
    tilt_step: str
    excitation_n2: Mapping[str, Array]
    disturbed: tuple[str, ...] = ()


def predicted_motion(
    rig: RigConfig, plan: Plan, report: Progress = lambda _, __: None
) -> PredictedMotion | None:
    """Return the largest motion in the records of a plan; None for a rig without a model.

    `report` is that of plan_session.

    Raises:
        ConfigError: the model does not fit a rig.
    """
    with threadpool_limits(1, "blas"):  # threads take longer for matrices this small
        return _predicted(rig, plan, report)


def _predicted(rig: RigConfig, plan: Plan, report: Progress) -> PredictedMotion | None:
    gap, tilt = (0.0, ""), (0.0, "")
    geometry = rig.geometry
    sensors = shape_matrix(geometry.sensors_x_m, geometry.sensors_y_m)
    coils = shape_matrix(geometry.coil_x_m, geometry.coil_y_m)
    T_coils = decoupling_matrix(geometry.coil_x_m, geometry.coil_y_m)
    squares: dict[str, Array] = {}
    loops: dict[float, StateSpace | None] = {}
    for step in plan.steps:
        if step.excitation is None and step.disturbing_beam is None:
            continue
        if step.beam_m not in loops:
            loops[step.beam_m] = loop_from_wrench(rig, step.beam_m, 1.0 / plan.rate_hz)
        loop = loops[step.beam_m]
        if loop is None:
            return None
        simulation = Simulation(loop)
        square, rows = np.zeros(len(coils)), 0
        for wrench, coil_squares in _causes(rig, step, 1.0 / plan.rate_hz, coils, T_coils):
            pose = simulation.respond(wrench)
            gap = max(gap, (float(np.abs(pose @ sensors.T).max()), step.name))
            tilt = max(tilt, (float(np.abs(pose[:, :2]).max()), step.name))
            square += coil_squares
            rows += len(wrench)
            if step.excitation is not None:
                report(step.name, len(wrench))
        squares[step.name] = square / max(rows, 1)
    disturbed = tuple(step.name for step in plan.steps if step.disturbing_beam is not None)
    return PredictedMotion(*gap, *tilt, squares, disturbed)


def _causes(
    rig: RigConfig, step: PlannedStep, period_s: float, coils: Array, T_coils: Array
) -> Iterator[tuple[Array, Array]]:
    """Yield blocks of a record: what moves the platform, a wrench (n, 3), and squares (C,) in N^2.

    The squares are sums over the block of the excitation's force in each coil.
    """
    carried = np.zeros((1, 3))
    if step.disturbing_beam is not None:
        carried = feed_forward(rig, period_s).wrench(step.disturbing_beam.setpoints())
        # At first the beam rests, and the integrators carry it.
        rest = np.array([[step.beam_m, 0.0, 0.0]])
        carried -= feed_forward(rig, period_s).wrench(rest)
    if step.excitation is None:
        for first in range(0, len(carried), _ROWS):
            yield -carried[first : first + _ROWS], np.zeros(len(coils))
        return
    for block in step.excitation.blocks():
        during = carried[block.first : block.first + block.rows] if len(carried) > 1 else carried
        yield block.wrench(coils) - during, block.coil_squares(T_coils)


def motion_finding(rig: RigConfig, plan: Plan, report: Progress = lambda _, __: None) -> Finding:
    """Return whether the predicted motion of a plan stays within the limits of the rig.

    `report` is that of plan_session.
    """
    return motion_within_limits(rig, predicted_motion(rig, plan, report))


def motion_within_limits(rig: RigConfig, found: PredictedMotion | None) -> Finding:
    """Return whether a predicted motion stays within the limits of the rig; None: unknown."""
    if found is None:
        return Finding(Check.MOTION, Outcome.UNKNOWN, "the rig has no model")
    if not found.gap_step:
        return Finding(Check.MOTION, Outcome.PASSED, "no excitation")
    limits = rig.limits
    parts = [f"gap up to {1e3 * found.gap_m:.3g} of {1e3 * limits.gap_m:.3g} mm"]
    passed = found.gap_m <= limits.gap_m
    worst = found.gap_step
    if limits.tilt_rad is not None:
        parts.append(f"tilt up to {1e3 * found.tilt_rad:.3g} of {1e3 * limits.tilt_rad:.3g} mrad")
        if passed and found.tilt_rad > limits.tilt_rad:
            passed, worst = False, found.tilt_step
    return Finding.of(
        Check.MOTION,
        passed,
        f"with the model, {', '.join(parts)}",
        f"lower the level of the excitation in step {worst}, or its share at low frequencies"
        if worst not in found.disturbed
        else f"step {worst}: move the beam less far or more slowly, or set beam_feedforward: true",
    )


def loop_from_wrench(rig: RigConfig, beam_m: float, period_s: float) -> StateSpace | None:
    """Return the closed loop from an added wrench to the pose; None for a rig without a model.

    Raises:
        ConfigError: the model does not fit a rig.
    """
    plant = declared_plant(rig, beam_m, period_s)
    if plant is None:
        return None
    controller = pi_controller(np.array(rig.control.kp), np.array(rig.control.ki), period_s)
    A = closed_loop(plant, controller)
    more = len(A) - len(plant.A)
    B = np.vstack([plant.B, np.zeros((more, plant.B.shape[1]))])
    C = np.hstack([plant.C, np.zeros((len(plant.C), more))])
    return StateSpace(A, B, C, np.zeros((len(C), B.shape[1])), period_s)
