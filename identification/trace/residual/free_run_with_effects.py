"""Simulate a record in free run with effects: the plant in its loop, without measurements.

Effects depend on the trajectory that they change. A fixed-point iteration finds the trajectory:
simulate with the effects along the last trajectory, evaluate them along the new one, until it
converges.
"""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ....model.effects.base import Signals, Term, total
from ....model.effects.combined_effects import together
from ...greybox.experiment.control_loop import ControlLoop
from ...greybox.free_run.free_run_simulation import (
    Start,
    beginning,
    controller_state,
    first_row,
    input_step,
    known_after,
    require_held,
    run_loop,
    run_open,
)
from ...greybox.prediction.discretisation import Motion, motion
from ...greybox.prediction.noise_model import Filter
from ...greybox.prediction.prediction_errors import settled
from ...rounding import TINY
from ..linearised.intersample_moments import force_moments
from ..linearised.linearisation_point import WorkingPoint, corrected_experiment, filter_of, filtered
from ..records.effect_signals import rate, trajectory
from ..records.record_from_log import TraceRecord
from ..search_options import SearchOptions
from .fixed_point_iteration import AndersonMixing, DampedSteps, settles

Array = NDArray[np.float64]

_MAX_ITERATIONS = SearchOptions.steps * SearchOptions.resolved
_SETTLED = SearchOptions.accuracy
"""Rms change of the readings at convergence, over the sensors' noise or the simulation's error."""
_LEAST = SearchOptions().negligible
"""Least step of a slope, over the spread of the motion."""
_KEPT = _MAX_ITERATIONS
"""Steps that the next one is extrapolated from. A lightly damped mass on a spring takes as many."""


@dataclass(frozen=True)
class EffectFreeRun:
    """Simulated readings (N, S) and poses (N, n); rows before `counts_from` are as measured.

    `settled`: whether the iteration converged; `change`: last rms change, in noise deviations.
    """

    gap: Array
    q: Array
    counts_from: int
    settled: bool
    change: float


@dataclass(frozen=True)
class Slopes:
    """Derivatives (N, n, n) of the effects' force by pose and velocity, at q and qd (N, n)."""

    stiffness: Array
    damping: Array
    q: Array
    qd: Array


def free_run(
    point: WorkingPoint, record: TraceRecord, sensor_sd: Array | None = None, begin: int = 0
) -> EffectFreeRun:
    """Simulate a record in free run; constant force and state are estimated from 5 s at its begin.

    sensor_sd (S,): noise of each sensor, if they differ. begin: row where the record begins; what
    was measured before only sets the state of effects that have a memory.

    Raises IdentificationError for a closed loop without a zero-order hold at the input.
    """
    require_held(record.experiment, point.hold)
    iteration = _Iteration(point, record, sensor_sd, begin)
    damped = DampedSteps()
    iteration.advance(damped, while_promising=True)
    if iteration.settled:
        return iteration.result()
    # The jump of a friction converges in damped steps; a mass on a spring, a long memory, does not.
    mixed = copy(iteration)
    mixed.advance(AndersonMixing(_KEPT))
    if not mixed.settled:
        iteration.advance(damped)
    return min(iteration, mixed, key=lambda i: (not i.settled, i.change)).result()


class _Iteration:
    """The fixed-point iteration of one record: trajectory q (N, n), commands u (N, p), and change.

    change: last rms change of the readings, in noise deviations. settled: whether it converged.
    """

    def __init__(
        self, point: WorkingPoint, record: TraceRecord, sensor_sd: Array | None, begin: int
    ) -> None:
        e = record.experiment
        at = motion(point.model, e, point.hold)
        self._point, self._record = point, record
        self._first = begin + first_row(e.rows(begin, record.rows))
        _, self._added = filtered(point, record, at)
        offset, self._state = _start(point, record, self._added, begin, self._first)
        seen = self._added.gap
        self._given = e.y if seen is None else e.y - seen @ record.places.decoupling.T
        self._at = settled(at, offset)
        sd = point.disturbance.sensor_sd if sensor_sd is None else sensor_sd
        self._sensors = record.places.sensor_shape / np.reshape(sd, (-1, 1))
        # A pose times this has the size of the readings that it gives, in fewer numbers.
        self._size = np.asarray(np.linalg.qr(self._sensors, mode="r"))
        self._q, self._u = self._simulated()
        self._before: Signals | None = None
        self._changes: tuple[float, ...] = ()
        self._within = 0.0
        self.settled = not point.placed

    @property
    def change(self) -> float:
        return self._changes[-1] if self._changes else np.inf

    def advance(self, steps: DampedSteps | AndersonMixing, while_promising: bool = False) -> None:
        """Iterate until it converges, or for so many steps; or while these promise to be enough."""
        begun = 0 if isinstance(steps, DampedSteps) else len(self._changes)
        while not self.settled and np.all(np.isfinite(self._q)):
            left = _MAX_ITERATIONS - (len(self._changes) - begun)
            if left == 0 or (while_promising and not settles(self._changes, left, self._within)):
                break
            self._step(steps)

    def result(self) -> EffectFreeRun:
        gap = self._q @ self._record.places.sensor_shape.T
        if self._added.gap is not None:
            gap = gap + self._added.gap
        return EffectFreeRun(gap, self._q, self._first, self.settled, self.change)

    def _step(self, steps: DampedSteps | AndersonMixing) -> None:
        point, record, q, u = self._point, self._record, self._q, self._u
        e, coil = record.experiment, record.coil
        if e.loop is not None:
            coil = record.coil_excitation + _shared(record, u)
        signals = trajectory(record, q, coil, point.lag_s)
        self._added = together(point.placed, signals)
        slopes = _slopes(point, signals, self._before, self._added)
        next_q, next_u = self._simulated()
        if slopes is not None and np.all(np.isfinite(next_q)):
            move = next_q - q
            more_q, more_u = _newton_correction(
                point, record, self._at, slopes, move, rate(move, e.Ts_s), self._first
            )
            next_q, next_u = next_q + more_q, next_u + more_u
        self._changes = (*self._changes, _rms((next_q - q) @ self._sensors.T))
        self._before = signals
        error = _rms(((e.y - next_q) @ self._sensors.T)[self._first :])
        self._within = _SETTLED * max(error, 1.0)
        self.settled = self.change < self._within
        self._q, self._u = steps.next((q, u), (next_q, next_u), (next_q - q) @ self._size.T)

    def _simulated(self) -> tuple[Array, Array]:
        return _simulate(
            self._point, self._record, self._at, self._added, self._first, self._state, self._given
        )


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _slopes(
    point: WorkingPoint, signals: Signals, before: Signals | None, added: Term
) -> Slopes | None:
    """Return the derivatives of the effects' forces by pose and velocity along a trajectory.

    With them the iteration is Newton's method, and converges where a fixed-point iteration would
    oscillate. The difference step is the last change of the trajectory, so that the jump of a
    friction force has a finite slope.
    """
    if added.force is None:
        return None
    n = signals.q.shape[1]
    stiffness, damping = np.zeros((signals.rows, n, n)), np.zeros((signals.rows, n, n))
    for name, slope in (("q", stiffness), ("qd", damping)):
        values: Array = getattr(signals, name)
        spread = values.std(axis=0)
        last = (
            SearchOptions.least_gain * spread
            if before is None
            else (values - getattr(before, name)).std(axis=0)
        )
        for i, difference in enumerate(np.maximum(last, _LEAST * spread) + TINY):
            lower, upper = (_force_at(point, signals, name, i, s * difference) for s in (-1.0, 1.0))
            slope[:, :, i] = (upper - lower) / (2 * difference)
    return Slopes(stiffness, damping, signals.q, signals.qd)


def _force_at(point: WorkingPoint, signals: Signals, name: str, column: int, by: float) -> Array:
    """Return the effects' force (N, n) with poses or velocities of one DOF changed."""
    values = getattr(signals, name).copy()
    values[:, column] += by
    moved = replace(signals, q=values) if name == "q" else replace(signals, qd=values)
    force = total([p.term(moved) for p in point.placed]).force
    return np.zeros_like(values) if force is None else force


def _start(
    point: WorkingPoint, record: TraceRecord, added: Term, begin: int, first: int
) -> tuple[Array, Array]:
    """Estimate constant force (n,) and state (2n,) at row `first` from the rows from `begin` on."""
    own = motion(point.model, record.experiment, point.hold)
    corrected, whole = corrected_experiment(point, record, own, added)
    kalman = filter_of(point, record, own)
    if not own.fixed:
        kalman = Filter(kalman.gain[begin:first], kalman.covariance[begin:first])
    seen = beginning(whole.rows(begin, first), first - begin)
    return known_after(seen, corrected.rows(begin, first), kalman)


def _shared(record: TraceRecord, u: Array) -> Array:
    """Return coil commands (N, C) for a wrench (N, p), without the excitation of single coils."""
    shape = record.places.coil_shape
    own = record.coil_excitation @ shape
    return np.asarray((u - own) @ np.linalg.pinv(shape))


def _simulate(
    point: WorkingPoint,
    record: TraceRecord,
    at: Motion,
    added: Term,
    first: int,
    state: Array,
    q_given: Array,
) -> tuple[Array, Array]:
    """Simulate poses (N, n) and commands (N, p); rows before `first` are given."""
    e = record.experiment
    if added.force is not None:
        at = replace(at, drift=at.drift + _force_moments(point, at, added.force))
    y, u = q_given.copy(), e.u.copy()
    if e.loop is None:
        if added.held is not None:
            driven = motion(point.model, replace(e, u=e.u + added.held), point.hold)
            at = replace(at, inputs=driven.inputs)
        y[first:] = run_open(at.rows(first, len(y)), state)
        return y, u
    known, seen = e.loop.feedforward, e.loop.seen
    if added.held is not None:
        # It acts like a command, but the controller does not include it.
        known = known + added.held
        u[:first] += added.held[:first]
    if added.gap is not None:
        seen = seen + added.gap @ record.places.decoupling.T
    loop = replace(e.loop, feedforward=known, seen=seen)
    start = Start(first, state, controller_state(e, first))
    run_loop(at, input_step(point.model, e, at), loop, start, y, u)
    return y, u if added.held is None else u - added.held


def _newton_correction(
    point: WorkingPoint,
    record: TraceRecord,
    at: Motion,
    slopes: Slopes,
    q: Array,
    qd: Array,
    first: int,
) -> tuple[Array, Array]:
    """Return the Newton correction of poses and commands for a trajectory change q, qd (N, n).

    The change alters the effects' forces, which move the plant again: simulate the plant with the
    slopes included, driven by the slopes times the change. The correction vanishes with the change,
    so the converged trajectory does not depend on errors of the slopes.
    """
    e, n = record.experiment, q.shape[1]
    force = np.einsum("nij,nj->ni", slopes.stiffness, q)
    force += np.einsum("nij,nj->ni", slopes.damping, qd)
    force[:first] = 0.0
    mobility = np.broadcast_to(at.mobility, slopes.stiffness.shape)
    # Matrices are those in the middle of a period: a delayed stiffness would add energy.
    soft = replace(
        at,
        K=at.K - mobility @ _between(slopes.stiffness),
        D=at.D - mobility @ _between(slopes.damping),
        B=_each(at.B, record.rows),
        mobility=np.ascontiguousarray(mobility),
        inputs=np.zeros_like(at.inputs),
        drift=_force_moments(point, at, force),
    )
    y, u = np.zeros_like(q), np.zeros_like(e.u)
    if e.loop is None:
        y[first:] = run_open(soft.rows(first, len(y)), np.zeros(2 * n))
        return y, u
    controller = e.loop.controller
    quiet = ControlLoop(
        np.zeros_like(u), np.zeros_like(e.loop.reference), np.zeros_like(u), np.zeros_like(y),
        controller.unlimited(),
    )  # fmt: skip
    start = Start(first, np.zeros(2 * n), np.zeros(len(controller.A)))
    run_loop(soft, input_step(point.model, e, soft), quiet, start, y, u)
    return y, u


def _force_moments(point: WorkingPoint, at: Motion, force: Array) -> Array:
    """Return the moments (N, J, n) of a generalised force (N, n), divided by M."""
    outer = force_moments(force, at.Ts_s, len(at.scale) - 1, point.hold)
    if len(at.mobility) == 1:
        return np.asarray(outer @ at.mobility[0].T)
    return np.asarray(outer @ np.swapaxes(at.mobility, 1, 2))


def _between(values: Array) -> Array:
    """Return values (N, ...) in the middle of each period."""
    return np.asarray(0.5 * (values + np.concatenate([values[1:], values[-1:]])))


def _each(values: Array, rows: int) -> Array:
    """Return one set of matrices for each row."""
    return np.ascontiguousarray(np.broadcast_to(values, (rows, *values.shape[1:])))
