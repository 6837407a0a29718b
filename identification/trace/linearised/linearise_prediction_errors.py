"""Linearise a record's prediction errors in parameters and candidates, as Gram matrices.

At a working point (a model with effects), the errors of a record are linear in small changes of the
parameters, in the amplitudes of effects, and in the unknown constant force and initial state, which
are projected out. The rest is stored as Gram matrices of short time blocks, which suffice for
regression and cross-validation without the record.
"""

from __future__ import annotations

import pickle
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import islice

import numpy as np
from numpy.typing import NDArray

from ....model.declared_model import DeclaredModel
from ....model.effects.base import Effect, Placed, Signals, Term, total
from ...rounding import DIFFERENCE, ROUNDING, TINY
from ..records.record_from_log import TraceRecord
from ..search_options import SearchOptions
from .drive_force_residual import drive_channel, drive_errors
from .gram_matrices import Linearised, ResidualChannel, block_edges, grams
from .innovations_filter_bank import FilterBank, thinned
from .linearisation_point import Along, WorkingPoint, along, thinning

Array = NDArray[np.float64]

Candidate = tuple[Effect, tuple[float, ...]]

_MAX_NUMBERS = SearchOptions.at_a_time * SearchOptions.at_a_time**2
"""Numbers in the candidates' columns at one time, 0.13 GB."""
_ROWS = SearchOptions.at_a_time
"""Rows that are projected at once: those of some hundred columns fit into a processor's cache."""


_POINTS = 2
"""Points whose preparation is kept: that of a search and the one that it tries."""


def linearise(
    point: WorkingPoint,
    record: TraceRecord,
    candidates: Sequence[Candidate],
    blocks: tuple[int, int] | None = None,
) -> Linearised:
    """Return the Gram matrices of a record; see Linearised for the order of the columns.

    blocks: first and last (exclusive) of its blocks, if not all. For long records, candidates are
    processed in batches, to limit memory.
    """
    if blocks is not None:
        record = record.part(*_rows_of(record, *blocks))
    here, bank, own, basis = _prepared(point, record)
    parts = [
        _with_candidates(point, here, bank, own, basis, some)
        for some in _batches(candidates, _MAX_NUMBERS // max(own.shape[0] * own.shape[1], 1))
    ]
    return replace(parts[0], beside=tuple(one for part in parts for one in part.beside))


def _prepared(point: WorkingPoint, record: TraceRecord) -> tuple[Along, FilterBank, Array, Array]:
    """Return what all candidates at a point have in common; of the last two points, kept.

    A search asks the same point again and again: of other candidates, of other shapes of them, and
    after another point that was no better.
    """
    key = pickle.dumps(point)
    kept = record.prepared.get(key)
    if kept is None:
        here = along(point, record)
        bank = FilterBank.build(point.model, record, here.at, here.kalman, point.hold, here.every)
        own = parameter_columns(point, bank, here.signals)
        kept = here, bank, own, _unknown_basis(point, here, bank)
        while len(record.prepared) >= _POINTS:
            del record.prepared[next(iter(record.prepared))]
    else:
        del record.prepared[key]
    record.prepared[key] = kept  # the last one, which is kept longest
    return kept


def _batches(candidates: Sequence[Candidate], most: int) -> Iterator[Sequence[Candidate]]:
    """Yield batches of candidates in order, with at most `most` columns, at least one candidate."""
    begin = columns = 0
    for i, (effect, _) in enumerate(candidates):
        width = len(effect.amplitudes)
        if columns and columns + width > most:
            yield candidates[begin:i]
            begin, columns = i, 0
        columns += width
    yield candidates[begin:]


def _with_candidates(
    point: WorkingPoint,
    here: Along,
    bank: FilterBank,
    own: Array,
    basis: Array,
    candidates: Sequence[Candidate],
) -> Linearised:
    record, s = here.record, here.signals
    placed = sum(len(p.amplitudes) + len(p.shape) for p in point.placed)
    widths = [len(effect.amplitudes) for effect, _ in candidates]
    count = placed + sum(widths)
    shown: list[Array | None] = [None] * len(point.parameters.names)
    shown_drive: list[Array | None] = [None] * len(point.parameters.names)

    def terms() -> Iterator[Term]:
        for p in point.placed:
            yield from effect_terms(p, s)
        for effect, shape in candidates:
            yield from effect.build(s, shape)

    def watched() -> Iterator[Term]:
        for term in terms():
            shown.append(None if term.gap is None else -beyond_pose(here, term.gap))
            shown_drive.append(None if term.drive is None else -thinned(term.drive, here.every))
            yield term

    pose = np.empty((*own.shape[:2], own.shape[2] + count + 1))
    pose[:, :, : own.shape[2]], pose[:, :, -1] = own, here.errors
    bank.columns(watched(), count, pose[:, :, own.shape[2] : -1])
    shown.append(beyond_pose(here, readings(here)))
    drive_n = drive_errors(here)
    shown_drive.append(None if drive_n is None else thinned(drive_n, here.every))
    flat = pose.reshape(-1, pose.shape[2])
    _project_out(flat, basis)
    _project_out_memory(flat[:, own.shape[2] + placed : -1], here, bank, basis, candidates)
    seen = [j for j, column in enumerate(shown) if column is not None]
    beyond = np.stack([column for column in shown if column is not None], axis=2)
    channels = [
        ResidualChannel(pose, list(range(pose.shape[2])), blind=here.at.blind / here.every),
        ResidualChannel(beyond, seen),
    ]
    shown_in_drive = [j for j, column in enumerate(shown_drive) if column is not None]
    if shown_in_drive:
        forces = np.stack([column for column in shown_drive if column is not None], axis=1)
        drive = drive_channel(here, forces)
        if drive is not None:
            channels.append(ResidualChannel(drive[:, None, :], shown_in_drive, own_noise=True))
    base = len(point.parameters.names) + placed
    return grams(record, channels, base, widths, here.every * record.experiment.Ts_s)


def _unknown_basis(point: WorkingPoint, here: Along, bank: FilterBank) -> Array:
    """Return an orthonormal basis of the unknowns, which is projected out of all columns.

    The unknowns are a constant force, the initial state, and the initial memory of effects. Along a
    moving beam the bank's columns have errors of 0.1 %, which matter for the large constant force
    of a candidate: so the basis also includes the constant force as the bank computes it.
    """
    unknowns = here.unknowns.reshape(-1, here.unknowns.shape[2])
    size = np.linalg.norm(unknowns, axis=0)
    basis, _ = np.linalg.qr(unknowns[:, size > 0.0] / size[size > 0.0])
    if here.record.experiment.moving:
        basis = _extended(basis, bank.constants())
    remembered = [
        term
        for p in point.placed
        if p.effect.initial_force_decay is not None
        for term in p.effect.initial_force_decay(here.signals, p.shape)
    ]
    return _extended(basis, bank.columns(remembered, len(remembered))) if remembered else basis


def _project_out(columns: Array, basis: Array) -> None:
    """Project an orthonormal basis (N', .) out of many columns (N', c), in place."""
    inner = basis.T @ columns
    for first in range(0, len(columns), _ROWS):
        some = slice(first, first + _ROWS)
        columns[some] -= basis[some] @ inner


def _project_out_memory(
    columns: Array, here: Along, bank: FilterBank, basis: Array, candidates: Sequence[Candidate]
) -> None:
    """Project the unknown initial memory out of the columns (N', .) of free forms, in place.

    The errors keep it: a candidate is assessed without its initial memory.
    """
    at = 0
    for effect, shape in candidates:
        width = len(effect.amplitudes)
        if effect.initial_force_decay is not None and effect.effect_class == "unknown":
            terms = effect.initial_force_decay(here.signals, shape)
            held = _extended(basis, bank.columns(terms, len(terms)))[:, basis.shape[1] :]
            own = columns[:, at : at + width]
            own -= held @ (held.T @ own)
        at += width


def _extended(basis: Array, columns: Array) -> Array:
    """Extend an orthonormal basis by columns (N', n, c)."""
    flat = columns.reshape(len(basis), -1)
    flat = flat / np.maximum(np.linalg.norm(flat, axis=0), TINY)
    for _ in range(2):  # twice, for accuracy: the remainder is small
        flat = flat - basis @ (basis.T @ flat)
    left, size, _ = np.linalg.svd(flat, full_matrices=False)
    return np.hstack([basis, left[:, size > ROUNDING]])


def _rows_of(record: TraceRecord, first: int, last: int) -> tuple[int, int]:
    """Return the rows of blocks first to last (exclusive); the last block has all that are left."""
    every = thinning(record.experiment.Ts_s)
    edges = block_edges(record.rows // every, every * record.experiment.Ts_s)
    end = record.rows if last == len(edges) - 1 else int(edges[last]) * every
    return int(edges[first]) * every, end


def blocks_in(record: TraceRecord) -> int:
    """Return the number of time blocks of a record in `linearise`."""
    every = thinning(record.experiment.Ts_s)
    return len(block_edges(record.rows // every, every * record.experiment.Ts_s)) - 1


def effect_terms(placed: Placed, signals: Signals) -> list[Term]:
    """Return the terms of an effect's amplitudes, then the derivatives by its shape parameters."""
    terms = placed.effect.build(signals, placed.shape)
    for i, quantity in enumerate(placed.effect.shape):
        span, value = quantity.high - quantity.low, abs(placed.shape[i])
        step = quantity.difference * value if quantity.log else DIFFERENCE * span
        low, high = list(placed.shape), list(placed.shape)
        low[i], high[i] = max(low[i] - step, quantity.low), min(high[i] + step, quantity.high)
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


def parameter_columns(point: WorkingPoint, bank: FilterBank, s: Signals) -> Array:
    """Return the columns of the model's parameters, each times the parameter's scale.

    For long records, parameters are filtered in batches, to limit memory.
    """
    forcings = _parameter_forcings(point, bank, s)
    most = max(_MAX_NUMBERS // (s.rows * 2 * s.q.shape[1]), 1)
    columns = [_no_columns(bank)]
    while some := list(islice(forcings, most)):
        columns.append(bank.errors(np.stack(some)))
    return np.concatenate(columns, axis=2)


def _parameter_forcings(point: WorkingPoint, bank: FilterBank, s: Signals) -> Iterator[Array]:
    """Yield the change of the state in each period (N, 2n) by each parameter."""
    for name, scale in zip(point.parameters.names, point.parameters.scale, strict=True):
        value, step = point.model.values[name], DIFFERENCE * scale
        below, above = value - step, value + step
        timing = name in point.model.lag.names | point.model.delay.names
        if timing:  # at a bound (zero delay), the difference is one-sided
            index = point.parameters.names.index(name)
            below = max(below, float(point.parameters.low[index]))
            above = min(above, float(point.parameters.high[index]))
        low, high = (point.model.with_values({name: at}) for at in (below, above))
        forcing = np.zeros((s.rows, 2 * s.q.shape[1]))
        if timing:
            forcing += _timing_forcing(bank, low, high)
        force, dB = _force_of(bank.record, point.model, name, (below, above), s)
        if np.any(force):
            forcing += bank.force_forcing(force)
        if np.any(dB):
            forcing += bank.held_forcing(bank.record.experiment.u, by=dB)
        yield forcing * (scale / (above - below))


def redundancy_basis(sensor_shape: Array) -> Array:
    """Return an orthonormal basis (S, S - n) of non-rigid readings."""
    left, _, _ = np.linalg.svd(sensor_shape, full_matrices=True)
    return np.asarray(left[:, sensor_shape.shape[1] :])


def readings(here: Along) -> Array:
    """Return the readings (N, S) without the known sensor effects."""
    gap, added = here.record.gap, here.added.gap
    return gap if added is None else gap - added


def beyond_pose(here: Along, values: Array) -> Array:
    """Return the non-rigid part (N', S - n) of readings (N, S), in noise standard deviations."""
    basis = redundancy_basis(here.record.places.sensor_shape)
    return thinned(values @ (basis / here.sd), here.every)


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
    record: TraceRecord,
    model: DeclaredModel,
    name: str,
    between: tuple[float, float],
    s: Signals,
) -> tuple[Array, Array]:
    """Return the change by a parameter along a record: force (N, n) and B (N or 1, n, p)."""
    e = record.experiment
    schedule = (
        dict(e.schedule) if e.moving else {k: np.array([v.mean()]) for k, v in e.schedule.items()}
    )
    changes = model.changes(name, *between, schedule)
    force = np.zeros_like(s.q)
    for key, values in (("M", s.qdd), ("D", s.qd), ("K", s.q)):
        for i, j, change in changes[key]:
            force[:, i] -= change * values[:, j]
    if e.moving:
        for _, j, change in changes["force"]:
            if model.force[j].names & set(model.scheduling):
                force[:, j] += change
    rows = len(next(iter(schedule.values()))) if schedule else 1
    dB = np.zeros((rows if changes["B"] else 1, len(model.B), len(model.B[0])))
    for i, j, change in changes["B"]:
        dB[:, i, j] = change
    return force, dB
