"""A trace from end to end: logs to a model with effects, judged on records that fitted nothing."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from copy import deepcopy
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from ...config.model import ModelConfig
from ...model.effects.base import Effect, Places
from ...model.effects.driven_range import Extent
from ...model.effects.effect_serialization import placed_effects
from ...model.effects.freeform import freeform_effects
from ..greybox.fit import first_noise, fit_model
from ..greybox.free_parameters import free_parameters
from ..greybox.model_file import declared_model
from ..records.record import IdentificationError
from .linearised.gram_matrices import BLOCK_S, Linearised
from .linearised.linearise import blocks_in, linearise
from .linearised.working_point import WorkingPoint, with_likely_noise
from .records.coil_loads import loads_of
from .records.initial_guesses import extent
from .records.noise_sources import disturbance, require_noise
from .records.read_records import read_records
from .records.session_time import overlap, require_timeless, timeless
from .records.trace_record import TraceRecord, split
from .residual.error_metric import RecordError, pooled, record_error
from .residual.random_vibration import Shaking, force_spectrum, shaking
from .search.candidate_screening import HeldError
from .search.free_form_readings import shown_beyond
from .search.gauss_newton import NEARLY, Candidate, refine
from .search.regression import FOLDS
from .search.search import Found, search, without_followers
from .worker_pool import RecordSource, Workers

Array = NDArray[np.float64]
Progress = Callable[[str, float], None]

_FIRST_ROWS = 8000
_FIRST_RECORDS = 8
_LOUDER = (1e9, 1e7, 1e5)
"""Times the force noise that there is: loud enough to begin from a model far off, and then less."""
_UNEXPLAINED = 1.1
"""Error over the floor from which on it is asked whether something shakes the platform."""


@dataclass(frozen=True)
class Trace:
    """What was found.

    `declared`: the model refitted with no effects but its own; `found`: the end of the search.
    before, after: errors of the held-out records, free-running, in the order of `held`. shaken:
    random forces among what is left.
    """

    config: ModelConfig
    places: Places
    declared: WorkingPoint
    found: Found
    fitted: tuple[str, ...]
    held: tuple[str, ...]
    before: tuple[RecordError, ...]
    after: tuple[RecordError, ...]
    notes: tuple[str, ...]
    shaken: tuple[Shaking, ...] = ()
    records: tuple[RecordSource, ...] = ()
    """Every record whole, fitted and held out."""


def trace(
    logs: Sequence[Path],
    config: ModelConfig,
    effects: Callable[[Places, Extent], Sequence[Effect]],
    workers: Workers,
    progress: Progress,
) -> Trace:
    """Return what records lack in the model of `config`, and the model with it.

    Raises IdentificationError: no records, too little of them, without noise, or records that the
    model does not fit.
    """
    # Every worker is one core, this process too: threads of the linear algebra would only fight.
    with threadpool_limits(1):
        return _trace(logs, config, effects, workers, progress)


def refit(
    logs: Sequence[Path], config: ModelConfig, workers: Workers, progress: Progress
) -> tuple[WorkingPoint, tuple[RecordError, ...]]:
    """Return the declared model refitted, and its errors on the records held out.

    It is where a trace begins: how much there is to explain. Raises IdentificationError.
    """
    with threadpool_limits(1):
        begun = _begin(logs, config, workers, progress)
        errors = workers.map(partial(record_error, begun.declared), begun.logged.kept)
        return begun.declared, tuple(errors)


@dataclass(frozen=True)
class _Begun:
    """Records split, and the declared model fitted to those that are not held out."""

    logged: _Logged
    declared: WorkingPoint
    places: Places
    covered: Extent
    fitted: tuple[str, ...]
    held: tuple[str, ...]
    overlapping: str
    notes: tuple[str, ...]
    records: tuple[RecordSource, ...]


def _trace(
    logs: Sequence[Path],
    config: ModelConfig,
    effects: Callable[[Places, Extent], Sequence[Effect]],
    workers: Workers,
    progress: Progress,
) -> Trace:
    begun = _begin(logs, config, workers, progress)
    declared, logged, places, notes = begun.declared, begun.logged, begun.places, begun.notes
    known = {p.effect.identity for p in declared.placed}
    listed = _visible(effects(places, begun.covered), places)
    others = [e for e in listed if e.identity not in known]
    unknown = freeform_effects(places, begun.covered)
    if begun.overlapping:
        others, timed = timeless(others, places, begun.covered)
        unknown, _ = timeless(unknown, places, begun.covered)
        if timed:
            kinds = ", ".join(dict.fromkeys(e.effect_class for e in timed))
            told = f"{begun.overlapping} overlap: effects that depend on a session's time"
            notes = (*notes, f"{told} are not looked for ({kinds})")
    found = search(declared, others, unknown, logged, progress)
    if {p.effect.identity for p in found.point.placed} == known:
        declared = found.point  # nothing was found: it is fitted to the end
    progress("simulating held-out records", 0.9)
    before = workers.map(partial(record_error, declared), logged.kept)
    after = workers.map(partial(record_error, found.point), logged.kept)
    error, floor = pooled(after)
    shaken: tuple[Shaking, ...] = ()
    if not error <= _UNEXPLAINED * floor:
        shaken = _shaken(found, logged, workers)
        fewer = without_followers(found, logged) if shaken else found
        if fewer is not found:
            found = fewer
            after = workers.map(partial(record_error, found.point), logged.kept)
            shaken = _shaken(found, logged, workers)
    return Trace(
        config, places, declared, found, begun.fitted, begun.held,
        tuple(before), tuple(after), notes, shaken, begun.records,
    )  # fmt: skip


def _shaken(found: Found, logged: _Logged, workers: Workers) -> tuple[Shaking, ...]:
    spectra = partial(force_spectrum, found.point)
    return shaking(workers.map(spectra, logged.fitted), workers.map(spectra, logged.kept))


def _begin(
    logs: Sequence[Path], config: ModelConfig, workers: Workers, progress: Progress
) -> _Begun:
    progress("reading logs", 0.0)
    records, notes = read_records(logs, config)
    span = (
        min(r.time_s[0] for r in records.values()),
        max(r.time_s[-1] for r in records.values()),
    )
    overlapping = overlap(list(records.values()))
    loads = None if overlapping else loads_of(list(records.values()))
    records = {
        path: replace(r, places=replace(r.places, span_s=span, loads=loads))
        for path, r in records.items()
    }
    train, held = split(list(records.values()))
    if not held:
        raise IdentificationError(
            "expected records long enough to hold a part of them out, found "
            f"{', '.join(f'{r.rows} rows of {r.name}' for r in records.values())}"
        )
    require_noise(train)
    _require_enough(train)
    whole = {
        r.name: RecordSource.of(path, 0, r.rows, span, loads, r.name) for path, r in records.items()
    }
    begin = {r.name: r.time_s[0] for r in records.values()}

    def sources(parts: Sequence[TraceRecord]) -> tuple[RecordSource, ...]:
        found = []
        for part in parts:
            first = round((part.time_s[0] - begin[part.name]) / part.experiment.Ts_s)
            found.append(replace(whole[part.name], start=first, stop=first + part.rows))
        return tuple(found)

    places = train[0].places
    covered = extent([*train, *held])
    if overlapping:
        declared_effects = placed_effects(config.effects, places, covered)
        require_timeless(declared_effects, places, covered, overlapping)
    progress("fitting the declared model", 0.05)
    parts = _parts(train)
    point = _start(config, parts, list(records.values()), covered)
    logged = _Logged(workers, sources(train), sources(held), tuple(parts))
    names = tuple(r.name for r in train), tuple(r.name for r in held)
    del records, train, held  # workers read them anew

    start = logged.believed(replace(point, reference=point.model))
    declared, _ = refine(start, logged, within=NEARLY)
    return _Begun(
        logged, declared, places, covered, *names, overlapping, notes, tuple(whole.values())
    )


@dataclass(frozen=True)
class _Logged:
    """Records that workers read from logs."""

    workers: Workers
    fitted: tuple[RecordSource, ...]
    kept: tuple[RecordSource, ...]
    parts: tuple[TraceRecord, ...]

    @property
    def sensor_shape(self) -> Array:
        return self.parts[0].places.sensor_shape

    def believed(self, point: WorkingPoint) -> WorkingPoint:
        return with_likely_noise(point, self.parts)

    def held_error(self, point: WorkingPoint) -> HeldError:
        error, floor = pooled(self.workers.map(partial(record_error, point), self.kept))
        return HeldError(error**2, floor**2)

    def train(
        self,
        point: WorkingPoint,
        candidates: Sequence[Candidate] = (),
        only: Sequence[int] | None = None,
    ) -> list[Linearised]:
        chosen = self.fitted if only is None else [self.fitted[i] for i in only]
        return self.workers.map(partial(linearise, point, candidates=tuple(candidates)), chosen)

    def shown(self, point: WorkingPoint, candidates: Sequence[Candidate]) -> list[Linearised]:
        asked = tuple(candidates)
        return self.workers.map(partial(shown_beyond, point, candidates=asked), self.fitted)

    def held(self, point: WorkingPoint, candidates: Sequence[Candidate] = ()) -> list[Linearised]:
        return self.workers.map(partial(linearise, point, candidates=tuple(candidates)), self.kept)


@dataclass(frozen=True)
class _Loaded:
    """Records at hand, to fit to."""

    records: Sequence[TraceRecord]

    def train(
        self,
        point: WorkingPoint,
        candidates: Sequence[Candidate] = (),
        only: Sequence[int] | None = None,
    ) -> list[Linearised]:
        chosen = self.records if only is None else [self.records[i] for i in only]
        return [linearise(point, record, candidates) for record in chosen]


def _require_enough(train: Sequence[TraceRecord]) -> None:
    """Raise IdentificationError for too few blocks of time to judge an effect by."""
    blocks = sum(blocks_in(r) for r in train)
    found = sum(r.rows * r.experiment.Ts_s for r in train)
    if blocks < FOLDS or found < (FOLDS - 0.5) * BLOCK_S:
        raise IdentificationError(
            f"expected at least {FOLDS * BLOCK_S:.0f} s of records to fit to ({FOLDS} blocks of "
            f"{BLOCK_S:.0f} s, by which effects are judged) beside those held out, found "
            f"{found:.3g} s in {len(train)} record{'s' if len(train) > 1 else ''}"
        )


def _visible(effects: Sequence[Effect], places: Places) -> list[Effect]:
    """Return the effects that records of a plant can show at all.

    Without more sensors than DOF a reading that is false in proportion to itself is a change of
    units: a fit would shrink the readings, and the errors with them.
    """
    if places.sensors > len(places.dof):
        return list(effects)
    return [e for e in effects if not any(w.startswith("sensor") for w in e.where)]


def _start(
    config: ModelConfig,
    parts: Sequence[TraceRecord],
    records: Sequence[TraceRecord],
    covered: Extent,
) -> WorkingPoint:
    """Return a working point near the declared model's best, from parts of some records.

    With much force noise the filter follows a record whatever the parameters are, and the errors
    are nearly linear in them; so it is taken to be loud first, and comes down to what it is.
    """
    parameters, model = free_parameters(config), declared_model(config)
    if any(r.still and r.experiment.loop is not None for r in records):
        noise = disturbance(model, records, first_noise([r.experiment for r in parts]))
    else:
        fit = fit_model(config, [r.experiment for r in parts])
        model, noise = fit.model, disturbance(fit.model, records, fit.noise)
    placed = placed_effects(config.effects, records[0].places, covered)
    point = WorkingPoint(model, parameters, placed, noise, config.input)

    for louder in _LOUDER if noise.measured else ():
        loud = noise.noise.scaled(force=louder)
        at, _ = refine(replace(point, disturbance=replace(noise, noise=loud)), _Loaded(parts))
        point = replace(at, disturbance=noise)
    if noise.measured:
        noise = disturbance(point.model, records, noise.noise)
    return replace(point, disturbance=noise)


def _parts(records: Sequence[TraceRecord]) -> list[TraceRecord]:
    moving = [r for r in records if not r.still] or list(records)
    chosen: list[TraceRecord] = []
    for kind in dict.fromkeys(r.kind for r in moving):
        chosen += [r for r in moving if r.kind == kind][:3]
    parts = []
    for record in chosen[:_FIRST_RECORDS]:
        first = max((record.rows - _FIRST_ROWS) // 2, 0)
        # A view would keep the whole record.
        parts.append(deepcopy(record.cut(first, min(first + _FIRST_ROWS, record.rows))))
    return parts
