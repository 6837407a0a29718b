"""The plant in its loop with effects in it, simulated from what was commanded and nothing measured.

Effects are evaluated along the trajectory that they themselves bend. Their forces are small beside
what moves the plant, so the trajectory is found by repetition: simulate with the forces along the
last one, evaluate them along the new one, until nothing changes.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ....model.effects.base import Signals, Term, total
from ...greybox.discretisation import Motion, motion
from ...greybox.experiment import ControlLoop
from ...greybox.free_run import (
    Start,
    beginning,
    first_row,
    input_step,
    integral_before,
    known_after,
    require_held,
    run_loop,
    run_open,
)
from ...greybox.noise_model import Filter
from ...greybox.prediction_errors import settled
from ..linearised.force_moments import force_moments
from ..linearised.working_point import WorkingPoint, corrected_experiment, filter_of, filtered
from ..records.effect_signals import rate, trajectory
from ..records.trace_record import TraceRecord

Array = NDArray[np.float64]

_MOST_ROUNDS = 40
_SETTLED = 1e-2
"""Change of the readings in units of the sensor noise below which the trajectory is found."""
_SWINGS = 0.7
_SHORTEST_STEP = 0.1


@dataclass(frozen=True)
class EffectFreeRun:
    """Readings (N, S) that the model says the sensors show; rows before `counts_from` are given.

    `settled` says whether repeating changed nothing any more, `change` by how much it still did.
    """

    gap: Array
    q: Array
    counts_from: int
    settled: bool
    change: float


@dataclass(frozen=True)
class Slopes:
    """Derivatives (N, n, n) of a force by pose and velocity, at poses and velocities (N, n)."""

    stiffness: Array
    damping: Array
    q: Array
    qd: Array


def free_run(point: WorkingPoint, record: TraceRecord) -> EffectFreeRun:
    """Simulate a record freely; constant force and state come from its first 5 s.

    Raises IdentificationError: a loop whose input is not held from sample to sample.
    """
    e = record.experiment
    require_held(e, point.hold)
    at = motion(point.model, e, point.hold)
    first = first_row(e)
    _, added = filtered(point, record, at)
    offset, state = _start(point, record, added, first)
    q_given = e.y if added.gap is None else e.y - added.gap @ record.places.decoupling.T
    at = settled(at, offset)
    change, ease = np.inf, 1.0
    q, u = _simulate(point, record, at, added, first, state, q_given)
    before: Signals | None = None
    for _ in range(_MOST_ROUNDS if point.placed else 0):
        if not np.all(np.isfinite(q)):
            break
        coil = record.coil
        if e.loop is not None:
            coil = record.coil_excitation + _shared(record, u)
        signals = trajectory(record, q, coil, point.lag_s)
        added = total([p.term(signals) for p in point.placed])
        slopes = _slopes(point, signals, before, added)
        next_q, next_u = _simulate(point, record, at, added, first, state, q_given)
        if slopes is not None and np.all(np.isfinite(next_q)):
            move = next_q - q
            more_q, more_u = _bent(point, record, at, slopes, move, rate(move, e.Ts_s), first)
            next_q, next_u = next_q + more_q, next_u + more_u
        slower, step = change, next_q - q
        change = float(np.sqrt(np.mean((step @ record.places.sensor_shape.T) ** 2)))
        change /= point.disturbance.sensor_sd
        # Where it swings rather than settles, it goes half the way.
        ease = max(0.5 * ease, _SHORTEST_STEP) if change > _SWINGS * slower else ease
        before, q, u = signals, q + ease * step, u + ease * (next_u - u)
        if change < _SETTLED:
            break
    gap = q @ record.places.sensor_shape.T
    if added.gap is not None:
        gap = gap + added.gap
    return EffectFreeRun(gap, q, first, not point.placed or change < _SETTLED, change)


def _slopes(
    point: WorkingPoint, signals: Signals, before: Signals | None, added: Term
) -> Slopes | None:
    """Return how the effects' forces change with pose and velocity along a trajectory.

    A force that depends on where the platform is bends the next trajectory at once; with its slope
    in the model the repetition is Newton's and settles where it would swing otherwise. The slope is
    that over what the trajectory still moves by: a friction that jumps looks no steeper than that.
    """
    if added.force is None:
        return None
    n = signals.q.shape[1]
    stiffness, damping = np.zeros((signals.rows, n, n)), np.zeros((signals.rows, n, n))
    for name, slope in (("q", stiffness), ("qd", damping)):
        values: Array = getattr(signals, name)
        spread = values.std(axis=0)
        last = 0.1 * spread if before is None else (values - getattr(before, name)).std(axis=0)
        for i, nudge in enumerate(np.maximum(last, 1e-3 * spread) + 1e-12):
            lower, upper = (_force_at(point, signals, name, i, s * nudge) for s in (-1.0, 1.0))
            slope[:, :, i] = (upper - lower) / (2 * nudge)
    return Slopes(stiffness, damping, signals.q, signals.qd)


def _force_at(point: WorkingPoint, signals: Signals, name: str, column: int, by: float) -> Array:
    """Return the effects' force (N, n) with poses or velocities of one DOF moved."""
    values = getattr(signals, name).copy()
    values[:, column] += by
    moved = replace(signals, q=values) if name == "q" else replace(signals, qd=values)
    force = total([p.term(moved) for p in point.placed]).force
    return np.zeros_like(values) if force is None else force


def _start(
    point: WorkingPoint, record: TraceRecord, added: Term, first: int
) -> tuple[Array, Array]:
    """Return the constant force (n,) and the state (2n,) at row `first`, from the rows before."""
    own = motion(point.model, record.experiment, point.hold)
    corrected, whole = corrected_experiment(point, record, own, added)
    kalman = filter_of(point, record, own)
    if not own.fixed:
        kalman = Filter(kalman.gain[:first], kalman.covariance[:first])
    return known_after(beginning(whole, first), corrected.rows(0, first), kalman)


def _shared(record: TraceRecord, u: Array) -> Array:
    """Return each coil's command (N, C) for a wrench (N, p) without the coils' own excitation."""
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
    """Return pose (N, n) and command (N, p); rows before `first` as given."""
    e = record.experiment
    if added.force is not None:
        at = replace(at, drift=at.drift + _pushes(point, at, added.force))
    y, u = q_given.copy(), e.u.copy()
    if e.loop is None:
        if added.held is not None:
            acted = motion(point.model, replace(e, u=e.u + added.held), point.hold)
            at = replace(at, inputs=acted.inputs)
        y[first:] = run_open(at.rows(first, len(y)), state)
        return y, u
    known, reference = e.loop.feedforward, e.loop.reference
    if added.held is not None:
        # It acts as a command does, and is none: the controller neither knows nor answers for it.
        known = known + added.held
        u[:first] += added.held[:first]
    if added.gap is not None:
        reference = reference - added.gap @ record.places.decoupling.T
    loop = ControlLoop(e.loop.v, reference, known, e.loop.controller)
    start = Start(first, state, integral_before(e, first))
    run_loop(at, input_step(point.model, e, at), loop, start, y, u)
    return y, u if added.held is None else u - added.held


def _bent(
    point: WorkingPoint,
    record: TraceRecord,
    at: Motion,
    slopes: Slopes,
    q: Array,
    qd: Array,
    first: int,
) -> tuple[Array, Array]:
    """Return by how much effects bend a trajectory (N, n) further that has moved by q, qd already.

    What it has moved by changes the effects' forces, which move it again: the plant with the slopes
    in it, driven by what they make of the move. It dies away with the move, so that where the
    repetition settles does not depend on how well the slopes are known.
    """
    e, n = record.experiment, q.shape[1]
    force = np.einsum("nij,nj->ni", slopes.stiffness, q)
    force += np.einsum("nij,nj->ni", slopes.damping, qd)
    force[:first] = 0.0
    mobility = np.broadcast_to(at.mobility, slopes.stiffness.shape)
    # Matrices hold in the middle of a period: a stiffness that came late would pump energy.
    soft = replace(
        at,
        K=at.K - mobility @ _between(slopes.stiffness),
        D=at.D - mobility @ _between(slopes.damping),
        B=_each(at.B, record.rows),
        mobility=np.ascontiguousarray(mobility),
        inputs=np.zeros_like(at.inputs),
        drift=_pushes(point, at, force),
    )
    y, u = np.zeros_like(q), np.zeros_like(e.u)
    if e.loop is None:
        y[first:] = run_open(soft.rows(first, len(y)), np.zeros(2 * n))
        return y, u
    quiet = ControlLoop(np.zeros_like(u), np.zeros_like(y), np.zeros_like(u), e.loop.controller)
    start = Start(first, np.zeros(2 * n), np.zeros(u.shape[1]))
    run_loop(soft, input_step(point.model, e, soft), quiet, start, y, u)
    return y, u


def _pushes(point: WorkingPoint, at: Motion, force: Array) -> Array:
    """Return moments (N, J, n) of a generalised force (N, n), divided by M."""
    outer = force_moments(force, at.Ts_s, len(at.scale) - 1, point.hold)
    if len(at.mobility) == 1:
        return np.asarray(outer @ at.mobility[0].T)
    return np.asarray(outer @ np.swapaxes(at.mobility, 1, 2))


def _between(values: Array) -> Array:
    """Return values (N, ...) in the middle of each period."""
    return np.asarray(0.5 * (values + np.concatenate([values[1:], values[-1:]])))


def _each(values: Array, rows: int) -> Array:
    """Return a set of matrices for every row where there is one for all."""
    return np.ascontiguousarray(np.broadcast_to(values, (rows, *values.shape[1:])))
