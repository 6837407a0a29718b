"""Simulate a record in free run: the model in its control loop, without measurements."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ....model.declared_model import DeclaredModel
from ...records.record import IdentificationError
from ..experiment.control_loop import ControlLoop
from ..experiment.experiment_from_log import Experiment
from ..experiment.intersample_input import HeldStep, Hold, held_step, lagged_input
from ..prediction import filter_kernels
from ..prediction.discretisation import Motion, innovations, motion, run_filter
from ..prediction.noise_model import Filter, Noise, kalman_filter
from ..prediction.prediction_errors import predict_along, settled

Array = NDArray[np.float64]

START_S = 5.0
"""Start of a record from which its state and constant force are estimated."""
_ROWS_A_STATE = 20
"""Recorded commands from which each state of the controller is estimated."""
_START_ROWS = 50
"""Least rows of that start: each DOF has three unknowns."""


@dataclass(frozen=True)
class FreeRun:
    """Simulated outputs (N, n) and commands (N, p); rows before `counts_from` are as recorded."""

    y: Array
    u: Array
    counts_from: int


@dataclass(frozen=True)
class Start:
    """Start of a run: the row, its state (2n,), and the controller's state (s,) there."""

    row: int
    state: Array
    controller: Array


def free_run(model: DeclaredModel, experiment: Experiment, hold: Hold, noise: Noise) -> FreeRun:
    """Simulate a record from its excitation, feed-forward and schedule alone.

    In closed loop the controller acts on the simulated outputs; in open loop the input is as
    recorded. The Kalman filter estimates state and constant force from the rows before first_row;
    later measurements are not used.

    Raises IdentificationError for a closed loop without a zero-order hold, and for fewer than nine
    rows.
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
        start = Start(first, state, controller_state(experiment, first))
        run_loop(at, input_step(model, experiment, at), experiment.loop, start, y, u)
    return FreeRun(y, u, first)


def require_held(experiment: Experiment, hold: Hold) -> None:
    """Raise IdentificationError for a closed loop without a zero-order hold at the input."""
    if experiment.loop is not None and hold != "zoh":
        raise IdentificationError(
            f"record '{experiment.name}': expected input: zoh in a closed loop, found '{hold}'"
        )


def first_row(experiment: Experiment) -> int:
    """Return the first row compared: after 5 s, at least 50 rows, at most a third of the record.

    Raises IdentificationError for fewer than nine rows, which do not determine the state.
    """
    rows = len(experiment.y)
    if rows < 9:
        raise IdentificationError(
            f"record '{experiment.name}': expected at least 9 rows to simulate, found {rows}"
        )
    return min(max(round(START_S / experiment.Ts_s), _START_ROWS), rows // 3)


def run_in_rows(counted: int, Ts_s: float) -> int:
    """Return the number of rows to simulate before `counted` rows, so that these all count."""
    return min(max(round(START_S / Ts_s), _START_ROWS), counted // 2)


def beginning(at: Motion, first: int) -> Motion:
    """Return the rows before `first`, with at most a quarter of them blind."""
    return replace(at.rows(0, first), blind=min(at.blind, first // 4))


def known_after(begin: Motion, experiment: Experiment, kalman: Filter) -> tuple[Array, Array]:
    """Estimate the constant force (n,) and the state (2n,) after the start of a record."""
    known = predict_along(begin, experiment, kalman)
    settled_in = settled(begin, known.offset)
    _, state = run_filter(settled_in, kalman.gain, experiment.y, known.start)
    return known.offset, state


def controller_state(experiment: Experiment, row: int) -> Array:
    """Return the controller's state (s,) at a row, from the recorded commands before it."""
    loop = experiment.loop
    assert loop is not None
    rows = slice(max(row - _ROWS_A_STATE * len(loop.controller.A), 0), row)
    reference, v = loop.reference[rows], loop.v[rows]
    seen, u = (experiment.y + loop.seen)[rows], (experiment.u - loop.feedforward)[rows]
    start = loop.controller.state_from(reference, seen, v, u)
    return loop.controller.output(reference, seen, v, start)[1]


def input_step(model: DeclaredModel, experiment: Experiment, at: Motion) -> HeldStep:
    """Return the effect of a held command within a period, after the model's delay and lag."""
    values = {**model.values, **model.scheduling}
    delay_s = max(experiment.delay_cycles * at.Ts_s + model.delay(values), 0.0)
    return held_step(at.Ts_s, len(at.scale) - 1, delay_s, max(model.lag(values), 0.0))


def run_open(at: Motion, state: Array) -> Array:
    """Simulate the outputs (N, n) in open loop from `state` (2n,) at row 0.

    `drift` may change between periods even if the matrices are fixed.
    """
    rows, n = len(at.inputs), at.K.shape[1]
    if at.fixed and len(at.drift) > 1:
        # The kernel for a fixed motion has a constant drift: a changing one becomes an input.
        B = np.concatenate([at.B, np.eye(n)[None]], axis=2)
        inputs = np.concatenate([at.inputs, at.drift], axis=2)
        at = replace(at, B=B, inputs=inputs, drift=np.zeros_like(at.drift[:1]))
    # With zero gain and y = 0, the innovations are minus the simulated outputs.
    gain = np.zeros((len(at.K), 2 * n, n))
    return -innovations(at, gain, np.zeros((rows, n)), state)


def run_loop(
    at: Motion, step: HeldStep, loop: ControlLoop, start: Start, y: Array, u: Array
) -> None:
    """Fill outputs y (N, n) and commands u (N, p) from the start's row on; earlier rows are given.

    Matrices and drift of the motion have one row for each period or a single one, independently.
    """
    c = loop.controller
    K, D, B, drift = (np.ascontiguousarray(x) for x in (at.K, at.D, at.B, at.drift))
    filter_kernels.closed_loop_along(
        K, D, B, drift, at.scale,
        loop.v, loop.reference, loop.feedforward, loop.seen,
        c.A, c.B, c.C, c.D, c.L, c.low, c.high, start.row, step.whole,
        step.from_old, step.from_new, step.from_lag,
        np.array([step.end_old, step.end_new, step.end_lag]),
        start.state.copy(), start.controller.copy(), lagged_input(u, step)[start.row].copy(), y, u,
    )  # fmt: skip
