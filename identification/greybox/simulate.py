"""Free-run simulation of a record: the model in its loop, told nothing of what was measured."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ...model.declared import DeclaredModel
from ..data import IdentificationError
from . import kernels
from .experiment import Experiment
from .inputs import Hold, held_step, lagged_input
from .motion import Motion, innovations, motion, run_filter
from .noise import Noise, kalman_filter
from .prediction import predict_along, settled

Array = NDArray[np.float64]

START_S = 5.0
"""The beginning of a record that may tell its state, its constant force, and nothing else."""


@dataclass(frozen=True)
class FreeRun:
    """Outputs (N, n), commands (N, p); rows before `counts_from` are as recorded."""

    y: Array
    u: Array
    counts_from: int


def free_run(model: DeclaredModel, experiment: Experiment, hold: Hold, noise: Noise) -> FreeRun:
    """Simulate a record from its excitation, its feed-forward and its schedule alone.

    In a loop the simulated outputs go through the controller; without one the input is as recorded.
    State and constant force come from the first 5 s (a third of a record shorter than 15 s), by the
    Kalman filter; from there on nothing measured is used.

    Raises IdentificationError: a loop whose input is not held from sample to sample.
    """
    if experiment.loop is not None and hold != "zoh":
        raise IdentificationError(f"expected a held input in a loop, found '{hold}'")
    first = min(round(START_S / experiment.Ts_s), len(experiment.y) // 3)
    whole = motion(model, experiment, hold)
    begin = replace(whole.rows(0, first), blind=min(whole.blind, first // 4))
    beginning = experiment.rows(0, first)
    known = predict_along(begin, beginning, kalman_filter(begin, noise))
    _, state = run_filter(
        settled(known.motion, known.offset), known.filter.gain, beginning.y, known.start
    )
    at = settled(whole, known.offset)
    y, u = experiment.y.copy(), experiment.u.copy()
    if experiment.loop is None:
        rest = at.rows(first, len(y))
        n = y.shape[1]
        gain = np.zeros((len(rest.K), 2 * n, n))
        y[first:] = -innovations(rest, gain, np.zeros((len(y) - first, n)), state)
    else:
        _close_loop(model, experiment, at, first, state, y, u)
    return FreeRun(y, u, first)


def _close_loop(
    model: DeclaredModel,
    experiment: Experiment,
    at: Motion,
    first: int,
    state: Array,
    y: Array,
    u: Array,
) -> None:
    """Fill y and u from row `first` on."""
    loop, Ts_s = experiment.loop, experiment.Ts_s
    assert loop is not None
    kp, ki_Ts = loop.controller.kp, loop.controller.ki * Ts_s
    values = {**model.values, **model.scheduling}
    delay_s = max(experiment.delay_cycles * Ts_s + model.delay(values), 0.0)
    step = held_step(Ts_s, len(at.scale) - 1, delay_s, max(model.lag(values), 0.0))
    # u = v + feed-forward + kp e + I holds of what was recorded: the integrator's state is known.
    error = loop.reference[first - 1] - experiment.y[first - 1]
    integral = u[first - 1] - loop.v[first - 1] - loop.feedforward[first - 1] - kp * error
    kernels.closed_loop_along(
        at.K, at.D, at.B, at.drift, at.scale,
        loop.v, loop.reference, loop.feedforward, kp, ki_Ts, first, step.whole,
        step.from_old, step.from_new, step.from_lag,
        np.array([step.end_old, step.end_new, step.end_lag]),
        state.copy(), integral, lagged_input(experiment.u, step)[first].copy(), y, u,
    )  # fmt: skip
