"""A record around a working point: its errors, and what every parameter and candidate does to them.

At a working point (a model with effects in it) the errors of a record are linear in small changes
of the model's parameters, in the amplitudes of effects, and in the constant force and the state at
the start, which nobody knows and which are taken out of everything else. What is left is kept as
Gram matrices of short blocks of time: every question about what helps, and whether it helps on data
that did not choose it, is answered from those without going back to the record.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar
from scipy.signal import welch

from ...model.declared import DeclaredModel
from ...model.effects.base import Effect, Placed, Signals, Term, total
from ..data import IdentificationError
from ..greybox.experiment import Experiment
from ..greybox.inputs import Hold, held_step, lagged_input
from ..greybox.motion import Motion, motion
from ..greybox.noise import Filter, Noise, kalman_filter
from ..greybox.parameters import FreeParameters
from ..greybox.prediction import predict_along, settled
from .filterbank import FilterBank, thinned
from .forces import force_moments
from .noise import Disturbance
from .record import TraceRecord
from .signals import measured_signals

Array = NDArray[np.float64]

_NUDGE = 1e-5
_TO_HZ = 250.0
"""Errors are averaged down to this rate: what a platform answers lies below half of it."""
_MOST_TRUST = 1e3
_OUTLIER = 4.0
_SLOW_HZ = 15.0
_NOISE_REACH = 21.0
_MOST_FILTERS = 8
_PASSES = 2
BLOCK_S = 4.0


@dataclass(frozen=True)
class WorkingPoint:
    """A model with the effects found so far; `parameters` are those of it that may change."""

    model: DeclaredModel
    parameters: FreeParameters
    placed: tuple[Placed, ...]
    disturbance: Disturbance
    hold: Hold
    trust: float = 1e3
    """By how much more force noise than there is the trajectory follows what was measured."""
    reference: DeclaredModel | None = None
    """The model whose filters serve along moving schedules; this one's own where none is given."""

    @property
    def lag_s(self) -> float:
        """Lag of the model's inputs, s."""
        return max(self.model.lag({**self.model.values, **self.model.scheduling}), 0.0)

    @property
    def values(self) -> Array:
        """Values of the free parameters (F,), SI."""
        return np.array([self.model.values[name] for name in self.parameters.names])


@dataclass(frozen=True)
class Linearised:
    """One record around a working point.

    gram (blocks, Q, Q): of [model's parameters over scale, amplitudes and shapes of the effects
    found, candidates' terms, errors], each column over `size` (Q,), that of the errors 1. count
    (blocks,) of errors.
    """

    name: str
    gram: Array
    size: Array
    count: Array
    time_s: Array


@dataclass(frozen=True)
class Channel:
    """Errors (N', i, c) of some of the columns, by number; the last column is the error itself."""

    errors: Array
    columns: list[int]


@dataclass(frozen=True)
class Along:
    """A record with its motion, filter and signals at a working point."""

    record: TraceRecord
    at: Motion
    kalman: Filter
    signals: Signals
    added: Term
    errors: Array
    unknowns: Array
    every: int
    sd: float


def along(point: WorkingPoint, record: TraceRecord) -> Along:
    """Return a record along the working point, its constant force and start fitted."""
    e = record.experiment
    at = motion(point.model, e, point.hold)
    kalman = filter_of(point, record, at)
    signals, added = filtered(point, record, at)
    corrected, acted = corrected_experiment(point, record, at, added)
    prediction = predict_along(acted, corrected, kalman)
    every = max(round(1 / (_TO_HZ * e.Ts_s)), 1)
    return Along(
        record, settled(at, prediction.offset), kalman, signals, added,
        thinned(prediction.errors, every), thinned(prediction.unknowns, every), every,
        point.disturbance.sensor_sd,
    )  # fmt: skip


def filter_of(point: WorkingPoint, record: TraceRecord, at: Motion, trust: float = 1.0) -> Filter:
    """Return the Kalman filter of a record, told `trust` times the force noise that there is.

    Any filter's errors are noise where the model is right, so along a moving schedule that of the
    reference model serves for all models like it: to find it takes longer than to use it.
    """
    noise = point.disturbance.noise
    noise = Noise(noise.force_psd * trust, noise.output_variance)
    if at.fixed:
        return kalman_filter(at, noise)
    model = point.model if point.reference is None else point.reference
    values = np.array([*model.values.values(), *noise.force_psd, *noise.output_variance])
    key = values.tobytes()
    if key not in record.filters:
        if len(record.filters) >= _MOST_FILTERS:
            record.filters.clear()
        reference = motion(model, record.experiment, point.hold)
        record.filters[key] = kalman_filter(reference, noise)
    return record.filters[key]


def filtered(point: WorkingPoint, record: TraceRecord, at: Motion) -> tuple[Signals, Term]:
    """Return the trajectory of a record and what the effects found so far add along it.

    At first the filter does not know the effects, and follows the readings closely; then it knows
    them, and may believe its model as far as that explains the records.
    """
    added = Term()
    closely = filter_of(point, record, at, _MOST_TRUST)
    believing = filter_of(point, record, at, point.trust)
    signals = measured_signals(record, at, record.experiment.y, closely, point.lag_s)
    for _ in range(_PASSES if point.placed else 0):
        added = total([p.term(signals) for p in point.placed])
        corrected, acted = corrected_experiment(point, record, at, added)
        signals = measured_signals(record, acted, corrected.y, believing, point.lag_s)
    if point.placed:
        added = total([p.term(signals) for p in point.placed])
    return signals, added


def linearise(
    point: WorkingPoint, record: TraceRecord, candidates: Sequence[tuple[Effect, tuple[float, ...]]]
) -> Linearised:
    """Return the Gram matrices of a record: see Linearised for the order of the columns."""
    here = along(point, record)
    bank = FilterBank.build(point.model, record, here.at, here.kalman, point.hold, here.every)
    s = here.signals
    count = sum(len(p.amplitudes) + len(p.shape) for p in point.placed)
    count += sum(len(effect.amplitudes) for effect, _ in candidates)
    shown: list[Array | None] = [None] * len(point.parameters.names)
    shown_drive: list[Array | None] = [None] * len(point.parameters.names)

    def terms() -> Iterator[Term]:
        for p in point.placed:
            yield from effect_terms(p, s)
        for effect, shape in candidates:
            yield from effect.build(s, shape)

    def watched() -> Iterator[Term]:
        for term in terms():
            shown.append(None if term.gap is None else -_beyond(here, term.gap))
            shown_drive.append(None if term.drive is None else -thinned(term.drive, here.every))
            yield term

    own = _parameter_columns(point, bank, s)
    pose = np.concatenate([own, bank.columns(watched(), count), here.errors[:, :, None]], axis=2)
    shown.append(_beyond(here, _readings(here)))
    shown_drive.append(_drive_errors(here))
    unknowns = here.unknowns.reshape(-1, here.unknowns.shape[2])
    basis, _ = np.linalg.qr(unknowns / np.maximum(np.linalg.norm(unknowns, axis=0), 1e-300))
    flat = pose.reshape(-1, pose.shape[2])
    flat -= basis @ (basis.T @ flat)
    seen = [j for j, column in enumerate(shown) if column is not None]
    beyond = np.stack([column for column in shown if column is not None], axis=2)
    channels = [
        Channel(pose, list(range(pose.shape[2]))),
        Channel(beyond, seen),
        *_drive_channel(here, shown_drive),
    ]
    return _grams(record, channels, here.every)


def with_likely_noise(point: WorkingPoint, records: Sequence[TraceRecord]) -> WorkingPoint:
    """Return the point with the force noise under which records are likeliest, model as it is.

    Where no record is still, the noise that drives the filter is all that the model lacks; it comes
    down as effects are found.
    """
    if point.disturbance.measured:
        return point
    noise = point.disturbance.noise
    parts = []
    for record in records:
        at = motion(point.model, record.experiment, point.hold)
        _, added = filtered(point, record, at)
        parts.append(corrected_experiment(point, record, at, added))

    def cost(log_level: float) -> float:
        tried = Noise(np.exp(log_level) * noise.force_psd, noise.output_variance)
        try:
            return sum(predict_along(at, e, kalman_filter(at, tried)).cost for e, at in parts)
        except IdentificationError:
            return np.inf

    levels = np.linspace(-_NOISE_REACH, _NOISE_REACH, 15)
    best = levels[np.argmin([cost(level) for level in levels])]
    step = levels[1] - levels[0]
    found = minimize_scalar(cost, bounds=(best - step, best + step), method="bounded")
    likely = Noise(float(np.exp(found.x)) * noise.force_psd, noise.output_variance)
    return replace(point, disturbance=replace(point.disturbance, noise=likely))


def effect_terms(placed: Placed, signals: Signals) -> list[Term]:
    """Return the terms of an effect's amplitudes, then what its shape does at its amplitudes."""
    terms = placed.effect.build(signals, placed.shape)
    for i, quantity in enumerate(placed.effect.shape):
        nudge = (
            1e-3 * abs(placed.shape[i]) if quantity.log else 1e-6 * (quantity.high - quantity.low)
        )
        low, high = list(placed.shape), list(placed.shape)
        low[i], high[i] = max(low[i] - nudge, quantity.low), min(high[i] + nudge, quantity.high)
        lower, upper = (
            total(
                [
                    t.times(a)
                    for t, a in zip(
                        placed.effect.build(signals, shape), placed.amplitudes, strict=True
                    )
                ]
            )
            for shape in (low, high)
        )
        terms.append(total([upper, lower.times(-1.0)]).times(1.0 / (high[i] - low[i])))
    return terms


def corrected_experiment(
    point: WorkingPoint, record: TraceRecord, at: Motion, added: Term
) -> tuple[Experiment, Motion]:
    """Return the experiment without false readings, and the motion with the effects' forces."""
    e = record.experiment
    if added.gap is not None:
        e = replace(e, y=e.y - added.gap @ record.places.decoupling.T)
    if added.held is not None:
        e = replace(e, u=e.u + added.held)
        at = motion(point.model, e, point.hold)
    if added.force is not None:
        order = len(at.scale) - 1
        outer = force_moments(added.force, e.Ts_s, order, point.hold)
        B = np.concatenate([at.B, at.mobility], axis=2)
        at = replace(at, B=B, inputs=np.concatenate([at.inputs, outer], axis=2))
    return e, at


def _parameter_columns(point: WorkingPoint, bank: FilterBank, s: Signals) -> Array:
    """Return what the model's parameters do, each in units of its scale."""
    columns = []
    for name, scale in zip(point.parameters.names, point.parameters.scale, strict=True):
        low, high = (
            point.model.with_values({name: point.model.values[name] + sign * _NUDGE * scale})
            for sign in (-1, 1)
        )
        forcing = np.zeros((s.rows, 2 * s.q.shape[1]))
        if name in point.model.lag.names | point.model.delay.names:
            forcing += _timing_forcing(bank, low, high)
        force, held = _force_of(bank.record, point.model, low, high, s)
        if np.any(force):
            forcing += bank.force_forcing(force)
        if np.any(held):
            forcing += bank.held_forcing(held)
        seen = np.zeros((s.rows, s.q.shape[1], 1))
        columns.append(bank.errors(forcing[:, :, None] / (2 * _NUDGE), seen))
    return np.concatenate(columns, axis=2) if columns else _no_columns(bank)


def _no_columns(bank: FilterBank) -> Array:
    n = bank.motion.K.shape[1]
    return np.zeros((bank.record.rows // bank.every, n, 0))


def _timing_forcing(bank: FilterBank, low: DeclaredModel, high: DeclaredModel) -> Array:
    u, model = bank.record.experiment.u, bank.model
    values = {**model.values, **model.scheduling}
    both = []
    for other in (low, high):
        there = {**other.values, **other.scheduling}
        both.append(
            bank.held_forcing(
                u, other.lag(there) - model.lag(values), other.delay(there) - model.delay(values)
            )
        )
    return both[1] - both[0]


def _force_of(
    record: TraceRecord, model: DeclaredModel, low: DeclaredModel, high: DeclaredModel, s: Signals
) -> tuple[Array, Array]:
    """Return the force (N, n) and the command (N, p) that two models differ by along a record."""
    e = record.experiment
    schedule = (
        dict(e.schedule) if e.moving else {k: np.array([v.mean()]) for k, v in e.schedule.items()}
    )
    lower, upper = low.over(schedule), high.over(schedule)
    force = np.zeros_like(s.q)
    for difference, values in (
        (upper.M - lower.M, s.qdd),
        (upper.D - lower.D, s.qd),
        (upper.K - lower.K, s.q),
    ):
        if np.any(difference):
            force -= np.einsum(
                "nij,nj->ni",
                np.broadcast_to(difference, (len(values), *difference.shape[1:])),
                values,
            )
    if e.moving:
        force += upper.force - lower.force
    dB = (upper.B - lower.B)[0]
    held = np.zeros_like(e.u)
    if np.any(dB):
        held = e.u @ np.linalg.lstsq(model.over(schedule).B[0], dB, rcond=None)[0].T
    return force, held


def _readings(here: Along) -> Array:
    """Return the readings (N, S) freed of what is known to be false in them."""
    gap, added = here.record.gap, here.added.gap
    return gap if added is None else gap - added


def _beyond(here: Along, readings: Array) -> Array:
    """Return what of readings (N, S) a rigid platform cannot show (N', S - n), in noise units."""
    basis = redundancy_basis(here.record.places.sensor_shape)
    return thinned(readings @ (basis / here.sd), here.every)


def redundancy_basis(sensor_shape: Array) -> Array:
    """Return an orthonormal basis (S, S - n) of readings that a rigid platform cannot show."""
    left, _, _ = np.linalg.svd(sensor_shape, full_matrices=True)
    return np.asarray(left[:, sensor_shape.shape[1] :])


def _drive_errors(here: Along) -> Array | None:
    """Return the force (N',) of the beam's drives less what the effects found add to it."""
    drive, added = here.record.drive_n, here.added.drive
    if drive is None:
        return None
    return thinned(drive if added is None else drive - added, here.every)


def _drive_channel(here: Along, shown: Sequence[Array | None]) -> list[Channel]:
    """Return the drives' force as a channel of its own, none where there are no drives.

    The drives move the beam's mass on a platform that tilts and jerks: what is proportional to
    accelerations and to the tilt is no effect, and is taken out. Its noise is unknown; the spread
    of what remains stands for it, so that no more is concluded from it than from its shape.
    """
    raw, s = here.record.drive_n, here.signals
    if raw is None:
        return []
    seen = [j for j, column in enumerate(shown) if column is not None]
    # What is proportional to speed is not told from a reading that comes half a period late.
    own = np.column_stack([np.ones(s.rows), s.v_b_m_s, s.a_b_m_s2, s.q, _accelerations(here)])
    basis, _ = np.linalg.qr(thinned(own / np.maximum(np.abs(own).max(axis=0), 1e-300), here.every))
    columns = np.stack([column for column in shown if column is not None], axis=1)
    columns -= basis @ (basis.T @ columns)
    rest = thinned(raw, here.every)
    rest = rest - basis @ (basis.T @ rest)
    # Where a profile jerks the beam its acceleration is not known between the samples.
    calm = np.abs(rest) <= _OUTLIER * float(np.std(rest))
    sd = float(np.std(rest[calm]))
    if sd <= 0.0:
        return []
    # It is not white: what few independent values it has is what its low frequencies say.
    every_s = here.every * here.record.experiment.Ts_s
    freq_hz, power = welch(np.where(calm, rest, 0.0), 1 / every_s, nperseg=min(512, len(rest)))
    slow = power[(freq_hz > 0) & (freq_hz < _SLOW_HZ)]
    sd *= float(np.sqrt(max(slow.mean() / power[1:].mean(), 1.0)))
    return [Channel((columns * calm[:, None] / sd)[:, None, :], seen)]


def _accelerations(here: Along) -> Array:
    """Return the pose's accelerations (N, n) at the rows, from the forces that act there.

    Twice differentiated readings would bury a friction of millinewtons.
    """
    e, at, s, n = here.record.experiment, here.at, here.signals, here.at.K.shape[1]
    step = held_step(e.Ts_s, 1, e.delay_cycles * e.Ts_s, s.lag_s)
    acting = lagged_input(e.u, step) if s.lag_s > 0.0 else s.acting(e.u)
    each = (s.rows, n, n)
    K, D = np.broadcast_to(at.K, each), np.broadcast_to(at.D, each)
    pushed = np.einsum("nip,np->ni", np.broadcast_to(at.B, (s.rows, *at.B.shape[1:])), acting)
    moved = np.einsum("nij,nj->ni", K, s.q) + np.einsum("nij,nj->ni", D, s.qd)
    own = np.broadcast_to(at.drift[:, 0] / e.Ts_s, s.q.shape)  # means over the period that follows
    now = 0.5 * (own + np.vstack([own[:1], own[:-1]]))
    if here.added.force is not None:
        mobility = np.broadcast_to(at.mobility, each)
        now = now + np.einsum("nij,nj->ni", mobility, here.added.force)
    return np.asarray(pushed - moved + now)


def _grams(record: TraceRecord, channels: Sequence[Channel], every: int) -> Linearised:
    rows, columns = len(channels[0].errors), channels[0].errors.shape[2]
    block = max(round(BLOCK_S / (every * record.experiment.Ts_s)), 1)
    edges = np.append(np.arange(0, max(rows - block // 2, 1), block), rows)
    squares = np.zeros(columns)
    for channel in channels:
        squares[channel.columns] += np.einsum("nic,nic->c", channel.errors, channel.errors)
    size = np.where(squares > 0, np.sqrt(squares), 1.0)
    size[-1] = 1.0
    grams = np.zeros((len(edges) - 1, columns, columns))
    for i, (first, last) in enumerate(pairwise(edges.tolist())):
        for channel in channels:
            part = channel.errors[first:last].reshape(-1, len(channel.columns))
            grams[i][np.ix_(channel.columns, channel.columns)] += part.T @ part
    grams /= size[:, None] * size
    width = sum(channel.errors.shape[1] for channel in channels)
    middle = record.time_s[np.minimum((edges[:-1] + edges[1:]) // 2 * every, record.rows - 1)]
    return Linearised(record.name, grams, size, np.diff(edges) * width, middle)
