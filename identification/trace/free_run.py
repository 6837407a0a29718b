"""The plant in its loop with effects in it, simulated from what was commanded and nothing measured.

Effects are evaluated along the trajectory that they themselves bend. Their forces are small beside
what moves the plant, so the trajectory is found by repetition: simulate with the forces along the
last one, evaluate them along the new one, until nothing changes.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ...model.effects.base import Signals, Term, total
from ..greybox import kernels
from ..greybox.inputs import held_step, lagged_input, moments
from ..greybox.motion import Motion, innovations, motion, run_filter
from ..greybox.noise import kalman_filter
from ..greybox.prediction import predict_along, settled
from .linearise import WorkingPoint, corrected_experiment, filtered
from .record import TraceRecord
from .signals import trajectory

Array = NDArray[np.float64]

START_S = 5.0
"""The beginning of a record may tell its state and its constant force, and does not count."""
_MOST_ROUNDS = 40
_SETTLED = 1e-2
_SWINGS = 0.7
_SHORTEST_STEP = 0.1
"""Change of the readings in units of the sensor noise below which the trajectory is found."""


@dataclass(frozen=True)
class FreeRun:
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


def free_run(point: WorkingPoint, record: TraceRecord) -> FreeRun:
    """Simulate a record freely; constant force and state come from its first 5 s."""
    e = record.experiment
    at = motion(point.model, e, point.hold)
    first = min(round(START_S / e.Ts_s), record.rows // 3)
    _, added = filtered(point, record, at)
    offset, state = _start(point, record, added, first)
    q_given = e.y if added.gap is None else e.y - added.gap @ record.places.decoupling.T
    last, change, ease = None, np.inf, 1.0
    at = settled(at, offset)
    softer: Slopes | None = None
    signals: Signals | None = None
    for _ in range(_MOST_ROUNDS if point.placed else 1):
        q, u = _simulate(point, record, at, added, first, state, q_given, softer)
        coil = record.coil
        if e.loop is not None:
            coil = record.coil_excitation + _shared(record, u)
        if not np.all(np.isfinite(q)):
            return FreeRun(q @ record.places.sensor_shape.T, q, first, False, np.inf)
        if signals is not None:
            q_seen = signals.q + ease * (q - signals.q)
            coil = signals.coil + ease * (coil - signals.coil)
        else:
            q_seen = q
        before, signals = signals, trajectory(record, q_seen, coil, point.lag_s)
        added = total([p.term(signals) for p in point.placed])
        gap = q @ record.places.sensor_shape.T
        if added.gap is not None:
            gap = gap + added.gap
        if last is not None:
            slower = change
            change = float(np.sqrt(np.mean((gap - last) ** 2))) / point.disturbance.sensor_sd
            # Where it swings rather than settles, it goes half the way.
            ease = max(0.5 * ease, _SHORTEST_STEP) if change > _SWINGS * slower else ease
        if not point.placed or change < _SETTLED:
            break
        softer = _slopes(point, signals, before, added)
        last = gap
    return FreeRun(gap, q, first, not point.placed or change < _SETTLED, change)


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
    beginning = record.cut(0, first)
    part = Term(*(None if a is None else a[:first] for a in added.parts))
    own = motion(point.model, beginning.experiment, point.hold)
    experiment, acted = corrected_experiment(point, beginning, own, part)
    kalman = kalman_filter(own, point.disturbance.noise)
    known = predict_along(acted, experiment, kalman)
    _, state = run_filter(settled(acted, known.offset), kalman.gain, experiment.y, known.start)
    return known.offset, state


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
    slopes: Slopes | None,
) -> tuple[Array, Array]:
    """Return pose (N, n) and command (N, p); rows before `first` as given."""
    e, model = record.experiment, point.model
    drift = at.drift
    force = added.force
    if force is not None and slopes is not None:
        mobility = np.broadcast_to(at.mobility, slopes.stiffness.shape)
        at = replace(at, K=at.K - mobility @ slopes.stiffness, D=at.D - mobility @ slopes.damping)
        force = force - np.einsum("nij,nj->ni", slopes.stiffness, slopes.q)
        force -= np.einsum("nij,nj->ni", slopes.damping, slopes.qd)
    if force is not None:
        outer = moments(force, e.Ts_s, len(at.scale) - 1, "foh", 0.0, 0.0)
        drift = drift + np.einsum(
            "nij,nkj->nki",
            np.broadcast_to(at.mobility, (record.rows, *at.mobility.shape[1:])),
            outer,
            optimize=True,
        )
    if len(at.K) > 1:
        at = replace(at, B=_each(at.B, record.rows), mobility=_each(at.mobility, record.rows))
    y, u = q_given.copy(), e.u.copy()
    if e.loop is None:
        moved = replace(at, drift=drift)
        if added.held is not None:
            acted = replace(e, u=e.u + added.held)
            moved = replace(motion(model, acted, point.hold), drift=drift)
        y[first:] = _open(moved, first, y, state)
        return y, u
    loop = e.loop
    kp, ki_Ts = loop.controller.kp, loop.controller.ki * e.Ts_s
    values = {**model.values, **model.scheduling}
    delay_s = max(e.delay_cycles * e.Ts_s + model.delay(values), 0.0)
    step = held_step(e.Ts_s, len(at.scale) - 1, delay_s, max(model.lag(values), 0.0))
    error = loop.reference[first - 1] - e.y[first - 1]
    integral = e.u[first - 1] - loop.v[first - 1] - loop.feedforward[first - 1] - kp * error
    known, reference = loop.feedforward, loop.reference
    if added.held is not None:
        # It acts as a command does, and is none: the controller neither knows nor answers for it.
        known = known + added.held
        u[:first] += added.held[:first]
    if added.gap is not None:
        reference = reference - added.gap @ record.places.decoupling.T
    kernels.closed_loop_along(
        np.ascontiguousarray(at.K), np.ascontiguousarray(at.D), at.B,
        np.ascontiguousarray(drift), at.scale,
        loop.v, reference, known, kp, ki_Ts, first, step.whole,
        step.from_old, step.from_new, step.from_lag,
        np.array([step.end_old, step.end_new, step.end_lag]),
        state.copy(), integral, lagged_input(u, step)[first].copy(), y, u,
    )  # fmt: skip
    return y, u if added.held is None else u - added.held


def _each(values: Array, rows: int) -> Array:
    """Return a set of matrices for every row where there is one for all."""
    return np.ascontiguousarray(np.broadcast_to(values, (rows, *values.shape[1:])))


def _open(at: Motion, first: int, y: Array, state: Array) -> Array:
    """Return the pose from row `first` on of a plant without a loop."""
    cut = slice(first, None)
    drift = at.drift[cut] if len(at.drift) > 1 else at.drift
    if not at.fixed:
        drift = _each(drift, len(y) - first)
    n = y.shape[1]
    if at.fixed and len(drift) > 1:
        # The kernel for a fixed motion takes one drift: what changes goes in as an input.
        B = np.concatenate([at.B, np.eye(n)[None]], axis=2)
        inputs = np.concatenate([at.inputs[cut], drift], axis=2)
        rest = replace(at, B=B, inputs=inputs, drift=np.zeros_like(at.drift[:1]))
    elif at.fixed:
        rest = replace(at, inputs=at.inputs[cut])
    else:
        rest = replace(
            at, K=at.K[cut], D=at.D[cut], B=at.B[cut], mobility=at.mobility[cut], drift=drift,
            inputs=at.inputs[cut],
        )  # fmt: skip
    gain = np.zeros((len(rest.K), 2 * n, n))
    return -innovations(rest, gain, np.zeros((len(y) - first, n)), state)
