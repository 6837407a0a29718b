"""Run a trace: from logs to a model with effects, validated on held-out records."""

from __future__ import annotations

import pickle
from collections.abc import Callable, Sequence
from copy import deepcopy
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from time import perf_counter

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from ...config.model import ModelConfig
from ...model.effects.base import Effect, Places
from ...model.effects.effect_serialization import placed_effects
from ...model.effects.operating_range import Extent
from ..greybox.declared_model_from_config import declared_model
from ..greybox.fit import first_noise, fit_model
from ..greybox.free_parameters import free_parameters
from ..records.record import IdentificationError
from ..records.singular_equations import singular_equations
from .linearised.gram_matrices import Linearised
from .linearised.linearisation_point import WorkingPoint, with_likely_noise
from .linearised.linearise_prediction_errors import blocks_in, linearise
from .linearised.noise_removed_by_effects import noise_removed
from .records.check_common_session_time import overlap, require_timeless
from .records.coil_load_history import in_one_session
from .records.initial_guesses import extent
from .records.read_records import read_records
from .records.record_from_log import SHORTEST_S, TraceRecord, split
from .records.searched_effects import searched_effects
from .records.sensor_and_amplifier_noise import disturbance, require_noise
from .residual.free_run_error import RecordError, pooled, record_error
from .residual.random_vibration import RandomVibration, force_spectrum, shaking
from .search.gauss_newton import NEARLY, ROUGHLY, Candidate, Part, refine
from .search.nonrigid_screening import shown_beyond
from .search.regression import FOLDS
from .search.search import Found, search
from .search.tested_candidate import HeldError, TimeOverError
from .search_options import SearchOptions
from .worker_pool import Answer, RecordSource, Task, Workers

Array = NDArray[np.float64]
Progress = Callable[[str, float], None]

_FIRST_S = 2.0 * SearchOptions.block_s
_FIRST_RECORDS = SearchOptions().fewest_blocks
_LOUDER = (SearchOptions().inexact ** -2, 1.0 / SearchOptions().inexact)
"""Factors on the force noise: large for a poor initial model, then smaller."""
MOST_S = 600.0
"""Seconds after which a trace looks for no further effect, where nobody chooses."""
_AT_A_TIME = SearchOptions.at_a_time
"""Candidates that a worker is asked about at once where some records only are asked."""


@dataclass(frozen=True)
class Trace:
    """The result of a trace.

    `declared`: the refitted model with only its declared effects; `found`: the result of the
    search. before, after: free-run errors of the held-out records, in the order of `held`. shaken:
    random forces found in the residual.
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
    shaken: tuple[RandomVibration, ...] = ()
    records: tuple[RecordSource, ...] = ()
    """All complete records, fitted and held out."""
    options: SearchOptions = field(default_factory=SearchOptions)


def trace(
    logs: Sequence[Path],
    config: ModelConfig,
    effects: Callable[[Places, Extent], Sequence[Effect]],
    workers: Workers,
    progress: Progress,
    options: SearchOptions | None = None,
    most_s: float = MOST_S,
) -> Trace:
    """Find the effects that the model of `config` lacks, and fit the model with them.

    After `most_s` from the beginning nothing is looked for or fitted any more; a note says so.

    Raises IdentificationError without records, for too little data, readings without noise, or
    records that the model does not fit.
    """
    # Each process uses one core: BLAS threads would compete for the same cores.
    with threadpool_limits(1), singular_equations("the search for effects"):
        options = options or SearchOptions()
        return _trace(logs, config, effects, workers, progress, options, most_s)


def refit(
    logs: Sequence[Path], config: ModelConfig, workers: Workers, progress: Progress
) -> tuple[WorkingPoint, tuple[RecordError, ...]]:
    """Refit the declared model, and return it with its errors on the held-out records.

    This is the first step of a trace. Raises IdentificationError as trace does.
    """
    with threadpool_limits(1):
        begun = _begin(logs, config, workers, progress)
        errors = workers.map(partial(record_error, begun.declared), begun.logged.kept)
        return begun.declared, tuple(errors)


@dataclass(frozen=True)
class _Begun:
    """The split records, and the declared model fitted to the training records."""

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
    options: SearchOptions,
    most_s: float,
) -> Trace:
    ends_s = perf_counter() + most_s
    begun = _begin(logs, config, workers, progress)
    declared, logged, places, notes = begun.declared, begun.logged, begun.places, begun.notes
    known = {p.effect.identity for p in declared.placed}
    table = searched_effects(effects, declared.placed, places, begun.covered, begun.overlapping)
    notes = (*notes, *table.notes)
    # A random force is noise to the search: effects could only follow it. A line is not random.
    start = declared
    if not begun.covered.tones_hz:
        start = _with_random_forces(declared, _shaken(declared, logged, workers))
    if start is not declared:
        start, _ = refine(start, logged, within=NEARLY)
    # Without a lag, a law is the same before and behind it; this search has each law once.
    named = [e for e in table.named if not e.before_lag or declared.model.lagging]
    named = [e for e in named if not e.beside]
    found = search(start, named, table.free, logged.until(ends_s), progress, options)
    if perf_counter() > ends_s:
        ended = f"the search ended after {most_s / 60.0:.3g} min; this is what it found, and was"
        notes = (*notes, f"{ended} not compared with all that may fit as well")
    if start is not declared:
        point = replace(found.point, disturbance=declared.disturbance)
        found = replace(found, point=point)
    if {p.effect.identity for p in found.point.placed} == known:
        declared = found.point  # no effect was found: use the converged fit
    progress("simulating held-out records", options.share_done(options.most_effects + 1))
    before, after = logged.errors(declared), logged.errors(found.point)
    error, floor = pooled(after)
    shaken: tuple[RandomVibration, ...] = ()
    if not error <= options.explained * floor:
        shaken = _shaken(found.point, logged, workers)
    return Trace(
        config, places, declared, found, begun.fitted, begun.held,
        tuple(before), tuple(after), notes, shaken, begun.records, options,
    )  # fmt: skip


def _shaken(point: WorkingPoint, logged: _Logged, workers: Workers) -> tuple[RandomVibration, ...]:
    """Return the random forces in what a model leaves; none without a measured noise."""
    if not point.disturbance.measured:
        return ()
    spectra = partial(force_spectrum, point)
    return shaking(workers.map(spectra, logged.fitted), workers.map(spectra, logged.kept))


def _with_random_forces(point: WorkingPoint, shaken: Sequence[RandomVibration]) -> WorkingPoint:
    """Return the point with the densities of random forces added to the force noise."""
    if not shaken:
        return point
    noise = point.disturbance.noise
    factor = np.ones(len(noise.force_psd))
    for one in shaken:
        factor[one.dof] += one.density / noise.force_psd[one.dof]
    raised = replace(point.disturbance, noise=noise.scaled(force=factor))
    return replace(point, disturbance=raised)


def _begin(
    logs: Sequence[Path], config: ModelConfig, workers: Workers, progress: Progress
) -> _Begun:
    progress("reading logs", 0.0)
    records, notes = read_records(logs, config)
    _require_known_loops(list(records.values()))
    overlapping = overlap(list(records.values()))
    records = dict(zip(records, in_one_session(list(records.values())), strict=True))
    train, held = split(list(records.values()))
    if not held:
        raise IdentificationError(
            f"expected records with a part of at least {SHORTEST_S:g} s to hold out, found "
            f"{', '.join(f'{r.rows} rows of {r.name}' for r in records.values())}"
        )
    require_noise(train)
    _require_enough(train)
    whole = {
        r.name: RecordSource.of(path, 0, r.rows, r.places.span_s, r.places.loads, r.name)
        for path, r in records.items()
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
    progress("fitting the declared model", SearchOptions().share_done(-1))
    parts = _parts(train)
    begin_with = _Logged(workers, sources(parts), (), tuple(parts))
    point = _start(config, begin_with, list(records.values()), covered)
    logged = _Logged(workers, sources(train), sources(held), tuple(parts))
    names = tuple(r.name for r in train), tuple(r.name for r in held)
    del records, train, held  # the workers read the logs themselves

    start = logged.with_estimated_noise(replace(point, reference=point.model))
    declared, _ = refine(start, logged, within=ROUGHLY)
    return _Begun(
        logged, declared, places, covered, *names, overlapping, notes, tuple(whole.values())
    )


@dataclass(frozen=True)
class _Logged:
    """Records that the workers read from logs, until `ends_s` of `time.perf_counter`."""

    workers: Workers
    fitted: tuple[RecordSource, ...]
    kept: tuple[RecordSource, ...]
    parts: tuple[TraceRecord, ...]
    ends_s: float = np.inf
    _errors: dict[bytes, list[RecordError]] = field(default_factory=dict, repr=False)

    def until(self, ends_s: float) -> _Logged:
        """Return the same records with another end of the time."""
        return replace(self, ends_s=ends_s)

    def in_any_time(self) -> _Logged:
        return self.until(np.inf)

    def _map(
        self, task: Task[Answer] | Sequence[Task[Answer]], sources: Sequence[RecordSource]
    ) -> list[Answer]:
        if perf_counter() > self.ends_s:
            raise TimeOverError
        return self.workers.map(task, sources)

    @property
    def sensor_shape(self) -> Array:
        return self.parts[0].places.sensor_shape

    def with_estimated_noise(self, point: WorkingPoint) -> WorkingPoint:
        return with_likely_noise(point, self.parts)

    def noise_removed(self, point: WorkingPoint) -> Array:
        return np.concatenate(self._map(partial(noise_removed, point), self.fitted))

    def errors(self, point: WorkingPoint) -> Sequence[RecordError]:
        """Return the free-run errors of the held-out records, kept for each point of a search."""
        key = pickle.dumps(point)
        if key not in self._errors:
            self._errors[key] = self._map(partial(record_error, point), self.kept)
        return self._errors[key]

    def held_error(self, point: WorkingPoint) -> HeldError:
        errors = self.errors(point)
        error, floor = pooled(errors)
        return HeldError(error**2, floor**2, np.concatenate([e.blocks for e in errors]))

    def train(
        self,
        point: WorkingPoint,
        candidates: Sequence[Candidate] = (),
        only: Sequence[Part] | None = None,
    ) -> list[Linearised]:
        if only is None:
            whole = partial(linearise, point, candidates=tuple(candidates))
            return self._map(whole, self.fitted)
        # Few parts would keep few workers busy: each is asked about some of the candidates.
        some = _split(candidates, _AT_A_TIME)
        tasks = [
            partial(linearise, point, candidates=these, blocks=(part.first, part.last))
            for part in only
            for these in some
        ]
        sources = [self.fitted[part.record] for part in only for _ in some]
        answers = self._map(tasks, sources)
        each = [answers[i : i + len(some)] for i in range(0, len(answers), len(some))]
        return [
            replace(own[0], beside=tuple(one for these in own for one in these.beside))
            for own in each
        ]

    def shown(self, point: WorkingPoint, candidates: Sequence[Candidate]) -> list[Linearised]:
        chosen = tuple(candidates)
        return self._map(partial(shown_beyond, point, candidates=chosen), self.fitted)

    def held(self, point: WorkingPoint, candidates: Sequence[Candidate] = ()) -> list[Linearised]:
        return self._map(partial(linearise, point, candidates=tuple(candidates)), self.kept)


def _split(candidates: Sequence[Candidate], most: int) -> list[tuple[Candidate, ...]]:
    """Return the candidates in groups of at most `most`; one group if there are none."""
    return [tuple(candidates[i : i + most]) for i in range(0, max(len(candidates), 1), most)]


def _require_known_loops(records: Sequence[TraceRecord]) -> None:
    """Raise IdentificationError for a loop with an unknown controller.

    A free run of it would drift, or follow the noise that the controller fed back.
    """
    for record in records:
        if record.experiment.feedback and record.experiment.loop is None:
            raise IdentificationError(
                f"record '{record.name}': loop: expected a controller, found 'unknown': with a "
                "scheduling variable in the model, a trace simulates the closed loop. State the "
                "controller in the signals file, or trace a model of one operating point"
            )


def _require_enough(train: Sequence[TraceRecord]) -> None:
    """Raise IdentificationError for too few blocks of time to judge an effect by."""
    blocks, block_s = sum(blocks_in(r) for r in train), SearchOptions.block_s
    found = sum(r.rows * r.experiment.Ts_s for r in train)
    if blocks < FOLDS or found < (FOLDS - 0.5) * block_s:
        raise IdentificationError(
            f"expected at least {FOLDS * block_s:.0f} s of records to fit to ({FOLDS} blocks of "
            f"{block_s:.0f} s, by which effects are judged) beside those held out, found "
            f"{found:.3g} s in {len(train)} record{'s' if len(train) > 1 else ''}"
        )


def _start(
    config: ModelConfig,
    logged: _Logged,
    records: Sequence[TraceRecord],
    covered: Extent,
) -> WorkingPoint:
    """Return an initial working point, fitted to the parts of some records in `logged`.

    With large force noise the filter follows the records for any parameters, and the errors are
    nearly linear in them. So the force noise starts large and is reduced in steps.
    """
    parameters, model = free_parameters(config), declared_model(config)
    if any(r.still and r.experiment.loop is not None for r in records):
        noise = disturbance(model, records, first_noise([r.experiment for r in logged.parts]))
    else:
        fit = fit_model(config, [r.experiment for r in logged.parts])
        model, noise = fit.model, disturbance(fit.model, records, fit.noise)
    placed = placed_effects(config.effects, records[0].places, covered)
    point = WorkingPoint(model, parameters, placed, noise, config.input)

    for louder in _LOUDER if noise.measured else ():
        loud = noise.noise.scaled(force=louder)
        loudly = replace(point, disturbance=replace(noise, noise=loud))
        at, _ = refine(loudly, logged, within=ROUGHLY)
        point = replace(at, disturbance=noise)
    if noise.measured:
        noise = disturbance(point.model, records, noise.noise)
    return replace(point, disturbance=noise)


def _parts(records: Sequence[TraceRecord]) -> list[TraceRecord]:
    moving = [r for r in records if not r.still] or list(records)
    chosen: list[TraceRecord] = []
    for kind in dict.fromkeys(r.kind for r in moving):
        chosen += [r for r in moving if r.kind == kind][: SearchOptions.patience]
    parts = []
    for record in chosen[:_FIRST_RECORDS]:
        most = round(_FIRST_S / record.experiment.Ts_s)
        first = max((record.rows - most) // 2, 0)
        # A copy, as a view would keep the whole record in memory.
        parts.append(deepcopy(record.cut(first, min(first + most, record.rows))))
    return parts
