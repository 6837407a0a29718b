"""Free-run simulation of a record: the model in its loop, told nothing of what was measured."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ...model.declared_model import DeclaredModel
from ..records.record import IdentificationError
from . import filter_kernels
from .discretisation import Motion, innovations, motion, run_filter
from .experiment import ControlLoop, Experiment
from .intersample_input import HeldStep, Hold, held_step, lagged_input
from .noise_model import Filter, Noise, kalman_filter
from .prediction_errors import predict_along, settled

Array = NDArray[np.float64]

START_S = 5.0
"""The beginning of a record that may tell its state, its constant force, and nothing else."""
_START_ROWS = 50
"""Of slow records so many rows at least: each DOF has three unknowns, in as much noise."""


@dataclass(frozen=True)
class FreeRun:
    """Outputs (N, n), commands (N, p); rows before `counts_from` are as recorded."""

    y: Array
    u: Array
    counts_from: int


@dataclass(frozen=True)
class Start:
    """Where a run begins: the row, the state (2n,) there, the integrators (p,) before it."""

    row: int
    state: Array
    integral: Array


def free_run(model: DeclaredModel, experiment: Experiment, hold: Hold, noise: Noise) -> FreeRun:
    """Simulate a record from its excitation, its feed-forward and its schedule alone.

    In a loop the simulated outputs go through the controller; without one the input is as recorded.
    State and constant force come from the rows before first_row, by the Kalman filter; from there
    on nothing measured is used.

    Raises IdentificationError: a loop whose input is not held from sample to sample; fewer than
    nine rows.
    """
    require_held(experiment, hold)
    first = first_row(experiment)
    whole = motion(model, experiment, hold)
    begin = beginning(whole, first)
    offset, state = known_after(begin, experiment.rows(0, first), kalman_filter(begin, noise))
    at = settled(whole, offset)
    y, u = experiment.y.copy(), experiment.u.copy()
    if experiment.loop is None:
        y[first:] = run_open(at.rows(first, len(y)), state)
    else:
        start = Start(first, state, integral_before(experiment, first))
        run_loop(at, input_step(model, experiment, at), experiment.loop, start, y, u)
    return FreeRun(y, u, first)


def require_held(experiment: Experiment, hold: Hold) -> None:
    """Raise IdentificationError for a loop whose input is not held from sample to sample."""
    if experiment.loop is not None and hold != "zoh":
        raise IdentificationError(
            f"record '{experiment.name}': expected a held input in a loop, found '{hold}'"
        )


def first_row(experiment: Experiment) -> int:
    """Return the first row that counts: 5 s in, 50 rows at least, a third of a short record.

    Raises IdentificationError: fewer than nine rows, a third of which does not tell the state.
    """
    rows = len(experiment.y)
    if rows < 9:
        raise IdentificationError(
            f"record '{experiment.name}': expected at least 9 rows to simulate, found {rows}"
        )
    return min(max(round(START_S / experiment.Ts_s), _START_ROWS), rows // 3)


def beginning(at: Motion, first: int) -> Motion:
    """Return the rows before `first`, at least three quarters of them not blind."""
    return replace(at.rows(0, first), blind=min(at.blind, first // 4))


def known_after(begin: Motion, experiment: Experiment, kalman: Filter) -> tuple[Array, Array]:
    """Return what a beginning tells: the constant force (n,), and the state (2n,) after it."""
    known = predict_along(begin, experiment, kalman)
    settled_in = settled(begin, known.offset)
    _, state = run_filter(settled_in, kalman.gain, experiment.y, known.start)
    return known.offset, state


def integral_before(experiment: Experiment, row: int) -> Array:
    """Return the integrators (p,) before a row of a loop, which the record implies.

    u = v + feed-forward + kp e + I holds of what was recorded in the row before.
    """
    loop = experiment.loop
    assert loop is not None
    error = loop.reference[row - 1] - experiment.y[row - 1]
    before = experiment.u[row - 1] - loop.v[row - 1] - loop.feedforward[row - 1]
    return np.asarray(before - loop.controller.kp * error)


def input_step(model: DeclaredModel, experiment: Experiment, at: Motion) -> HeldStep:
    """Return how a held command acts within a period, behind the model's delay and lag."""
    values = {**model.values, **model.scheduling}
    delay_s = max(experiment.delay_cycles * at.Ts_s + model.delay(values), 0.0)
    return held_step(at.Ts_s, len(at.scale) - 1, delay_s, max(model.lag(values), 0.0))


def run_open(at: Motion, state: Array) -> Array:
    """Return the pose (N, n) of a motion from `state` (2n,) at its row 0, without a loop.

    Forces in `drift` may have a row a period where the matrices are fixed.
    """
    rows, n = len(at.inputs), at.K.shape[1]
    if at.fixed and len(at.drift) > 1:
        # The kernel for a fixed motion takes one drift: what changes goes in as an input.
        B = np.concatenate([at.B, np.eye(n)[None]], axis=2)
        inputs = np.concatenate([at.inputs, at.drift], axis=2)
        at = replace(at, B=B, inputs=inputs, drift=np.zeros_like(at.drift[:1]))
    # What a filter without gain leaves of a pose of nothing is minus the pose.
    gain = np.zeros((len(at.K), 2 * n, n))
    return -innovations(at, gain, np.zeros((rows, n)), state)


def run_loop(
    at: Motion, step: HeldStep, loop: ControlLoop, start: Start, y: Array, u: Array
) -> None:
    """Fill pose y (N, n) and command u (N, p) from the start's row on; rows before are as given.

    Matrices and drift of the motion have a row a period or a single one, each by itself.
    """
    kp, ki_Ts = loop.controller.kp, loop.controller.ki * at.Ts_s
    K, D, B, drift = (np.ascontiguousarray(x) for x in (at.K, at.D, at.B, at.drift))
    filter_kernels.closed_loop_along(
        K, D, B, drift, at.scale,
        loop.v, loop.reference, loop.feedforward, kp, ki_Ts, start.row, step.whole,
        step.from_old, step.from_new, step.from_lag,
        np.array([step.end_old, step.end_new, step.end_lag]),
        start.state.copy(), start.integral.copy(), lagged_input(u, step)[start.row].copy(), y, u,
    )  # fmt: skip
