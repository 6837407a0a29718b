"""Free-run simulation of a record: the model in its loop, told nothing of what was measured."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...model.declared import DeclaredModel
from ..data import IdentificationError
from . import kernels
from .experiment import Experiment
from .inputs import Hold, held_step
from .motion import Motion, innovations, motion
from .noise import Noise
from .prediction import predict, settled

Array = NDArray[np.float64]

START_S = 5.0
"""The beginning of a record that may tell its state, its constant force, and nothing else."""


@dataclass(frozen=True)
class FreeRun:
    """Outputs (N, n), commands (N, p) of a simulated record; rows before `counts_from` are start."""

    y: Array
    u: Array
    counts_from: int


def free_run(model: DeclaredModel, experiment: Experiment, hold: Hold, noise: Noise) -> FreeRun:
    """Simulate a record from its excitation, its feed-forward and its schedule alone.

    In a loop the simulated outputs go through the controller; without one the input is as recorded.
    State and constant force come from the first 5 s (a third of a record shorter than 15 s).

    Raises IdentificationError: a loop whose input is not held from sample to sample.
    """
    rows = min(round(START_S / experiment.Ts_s), len(experiment.y) // 3)
    beginning = predict(model, experiment.rows(0, rows), hold, noise)
    at = settled(motion(model, experiment, hold), beginning.offset)
    loop = experiment.loop
    if loop is None:
        zero = np.zeros_like(experiment.y)
        gain = np.zeros((len(at.K), 2 * zero.shape[1], zero.shape[1]))
        return FreeRun(-innovations(at, gain, zero, beginning.start), experiment.u, rows)
    if hold != "zoh":
        raise IdentificationError(f"expected a held input in a loop, found '{hold}'")
    return _in_loop(model, experiment, at, beginning.start, rows)


def _in_loop(
    model: DeclaredModel, experiment: Experiment, at: Motion, start: Array, rows: int
) -> FreeRun:
    loop, Ts_s = experiment.loop, experiment.Ts_s
    assert loop is not None
    kp, ki_Ts = loop.controller.kp, loop.controller.ki * Ts_s
    values = {**model.values, **model.scheduling}
    step = held_step(
        Ts_s,
        len(at.scale) - 1,
        max(experiment.delay_cycles * Ts_s + model.delay(values), 0.0),
        max(model.lag(values), 0.0),
    )
    # u = v + feed-forward + kp e + I holds of what was recorded: the integrator's start is known.
    error = loop.reference[0] - experiment.y[0]
    integral = experiment.u[0] - loop.v[0] - loop.feedforward[0] - kp * error - ki_Ts * error
    y, u = np.empty_like(experiment.y), np.empty_like(experiment.u)
    kernels.closed_loop_along(
        at.K, at.D, at.B, at.drift, at.scale,
        loop.v, loop.reference, loop.feedforward, kp, ki_Ts, step.whole,
        step.from_old, step.from_new, step.from_lag,
        np.array([step.end_old, step.end_new, step.end_lag]),
        start, integral, experiment.u[0].copy(), y, u,
    )  # fmt: skip
    return FreeRun(y, u, rows)
