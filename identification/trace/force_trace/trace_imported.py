"""Trace imported records: fit the declared model, search for effects, report on unseen rows."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from ....config.model import ModelConfig
from ....model.effects.base import Effect, Places
from ....model.effects.operating_range import Extent
from ...greybox.force_balance.band_limited_signals import (
    BAND_STEPS,
)
from ...greybox.free_parameters import FreeParameters
from ...greybox.identify_greybox import stated_noise
from ...nonparametric.records_without_a_model import why_no_model
from ...records.record import Record
from ...records.singular_equations import singular_equations
from ...value_with_interval import PERCENT
from ..force_balance.force_record import ForceModel, ForceRecord, force_records
from ..force_balance.lines_in_missing_force import missing_lines
from ..force_balance.noise_through_laws import noise_with_laws
from ..force_balance.position_spectrum import position_periods
from ..force_balance.reported_errors import PooledError, ReportedError, reported_error
from ..force_checks.certainty_of_effects import Certainty, FittedRows, without_effect
from ..force_checks.exchanged_columns import Exchange
from ..force_checks.instrumental_variables import Unbiased
from ..force_checks.notes_on_numbers import notes_on_numbers
from ..force_checks.output_error_fit import output_error
from ..force_checks.simpler_laws import with_plain_laws, with_simpler_laws
from ..force_regression.candidate_fit import lacked
from ..force_regression.training_records import Training
from ..force_search.free_form_of_law_signal import curves_beside_laws
from ..force_search.opposite_gain import with_opposite_gains
from ..force_search.rated_candidate import Rated
from ..force_search.scale_of_equations import (
    freed_if_told,
    notes_on_held,
    without_scales,
)
from ..force_search.search import Progress, Searched, compared, search
from ..force_search.weighed_records import between_turns, training_below, unweighed, weighed
from ..records.check_common_session_time import overlap
from ..records.initial_guesses import extent
from ..records.read_records import read_records
from ..records.record_from_log import TraceRecord
from ..records.searched_effects import SearchedEffects, searched_effects
from ..search_options import SearchOptions
from .column_hint import balance_of_records, declared_start, explaining_columns

Array = NDArray[np.float64]

_MIDDLE = BAND_STEPS[len(BAND_STEPS) // 2]


@dataclass(frozen=True)
class ForceTrace:
    """The result of a trace of imported records.

    declared: the refitted model without new effects; found: the search's result; errors: standard
    errors of its numbers, correlations (K, K) theirs; force_errors: relative ones of the forces of
    each effect's amplitudes, in the point's order. before, after: errors on the reported rows.
    rows: what is missing in the fitted rows, with a free form too, and what of it is noise;
    between: the same without the turns of DOF with friction, None without any. unseen (2, n): what
    linear terms and a form of the motion leave of blocks that did not fit them. left_share: for
    each effect found, the share of the squared missing force without it that is left with it,
    beyond the noise of the outputs; leaning: the same without the effects in doubt. impossible:
    what of the model cannot be with an effect, by its identity, or without any. exchange: what
    columns have to be for a model without effects to explain as much. outputs: errors of a model
    without effects that is fitted to the outputs, on the reported rows; None if their noise is
    stated, or a free run tells nothing. curves: free forms of a law's
    signal that surely improve on it, by the law's identity. noise_sd (n,): of each output;
    noise_stated: whether the signals files state it. fitted, reported: the records below the band's
    limit `limit_hz`. doubts: why the records can show no effect, whatever fits them.
    """

    config: ModelConfig
    places: Places
    declared: ForceModel
    found: Searched
    errors: Array
    correlations: Array
    force_errors: Sequence[Array]
    before: tuple[ReportedError, ...]
    after: tuple[ReportedError, ...]
    rows: FittedRows
    between: FittedRows | None
    unseen: Array
    left_share: tuple[float, ...]
    leaning: tuple[float, ...]
    impossible: Mapping[str, tuple[str, ...]]
    exchange: Exchange | None
    outputs: PooledError | None
    curves: Mapping[str, Rated]
    noise_sd: Array
    noise_stated: bool
    limit_hz: float
    fitted: tuple[ForceRecord, ...]
    reported: tuple[ForceRecord, ...]
    notes: tuple[str, ...]
    options: SearchOptions
    doubts: tuple[str, ...] = ()


def trace_imported(
    logs: Sequence[Path],
    config: ModelConfig,
    effects: Callable[[Places, Extent], Sequence[Effect]],
    progress: Progress,
    options: SearchOptions | None = None,
) -> ForceTrace:
    """Find the effects that the model of `config` lacks in imported records.

    The last quarter of every record only reports. Raises IdentificationError without records, and
    for records that are too short.
    """
    progress("reading logs", 0.0)
    records, notes = read_records(logs, config, 0.0)
    found = trace_records(list(records.values()), config, effects, progress, options, notes)
    return replace(found, doubts=why_no_model([_record(r) for r in records.values()]))


def _record(record: TraceRecord) -> Record:
    e, places = record.experiment, record.places
    units = tuple(places.command_unit(c) for c in range(places.coils))
    return Record(
        e.name, e.Ts_s, e.u, e.y, places.actuators, units, places.dof, places.dof_units,
        feedback=e.feedback, held=e.hold == "zoh",
    )  # fmt: skip


def trace_records(
    records: Sequence[TraceRecord],
    config: ModelConfig,
    effects: Callable[[Places, Extent], Sequence[Effect]],
    progress: Progress,
    options: SearchOptions | None = None,
    notes: tuple[str, ...] = (),
) -> ForceTrace:
    """Return the same for records in memory; `notes` become those of the result."""
    # Every matrix is small: BLAS threads would cost more than they give.
    with threadpool_limits(1), singular_equations("the search for effects"):
        return _traced(records, config, effects, progress, options or SearchOptions(), notes)


def _traced(
    records: Sequence[TraceRecord],
    config: ModelConfig,
    effects: Callable[[Places, Extent], Sequence[Effect]],
    progress: Progress,
    options: SearchOptions,
    notes: tuple[str, ...],
) -> ForceTrace:
    balance = balance_of_records(records, config, options)
    records, model, sd, options = balance.records, balance.model, balance.sd, balance.options
    hold, limit_hz, law_hz = balance.hold, balance.limit_hz, balance.law_hz
    begins, train, fitted = balance.begins, balance.train, balance.fitted
    whole = force_records(records, hold, limit_hz, law_hz, sd)
    reported = _counted_behind(begins, whole)
    noisy, more = [_noisier(r, sd, seed) for seed, r in enumerate(records)], np.sqrt(2.0) * sd
    places = records[0].places
    covered = _within_band(extent(train), limit_hz)

    progress("fitting the declared model", options.share_done(-1))
    start = declared_start(balance, config, covered)
    training, declared, held_for = unweighed(start, fitted, limit_hz, options)
    training, declared = weighed(training, declared, (), options)
    covered = _with_lines(covered, declared, fitted, limit_hz)
    table = _lacking(effects, declared, training, covered, overlap(records), options)
    free = [e for e in table.free if e.where[0] in places.dof]

    def searched(training: Training, begun: Searched | None, most: int) -> Searched:
        limited = replace(options, most_effects=most)
        return search(declared, table.named, free, training, limited, progress, begun)

    def judged(found: Searched, training: Training) -> Certainty:
        others = [
            training_below(found.point, train, hold, limit_hz * _MIDDLE / step, law_hz, sd, options)
            for step in BAND_STEPS
            if step != _MIDDLE
        ]
        unbiased = Unbiased.of(found.point, training, others, train, hold, law_hz, sd, options)
        others.append(
            training_below(
                found.point, [r.cut(0, at) for r, at in zip(noisy, begins, strict=True)],
                hold, limit_hz, law_hz, more, options,
            )
        )  # fmt: skip
        parts = between_turns(found.point, training, options)
        return Certainty.of(found, fitted, training, others, options, model.values, unbiased, parts)

    found = None
    if held_for:  # a scale that is held wrongly may look like a second effect: ask after the first
        training, found = _searched_and_told(searched, training, None, 1, start.parameters, options)
    training, found = _searched_and_told(
        searched, training, found, options.most_effects, start.parameters, options
    )
    progress("comparing rivals", options.share_done(options.most_effects))
    for settled in (compared, with_simpler_laws, with_opposite_gains):
        found = settled(found, table.named, training, options)
    progress("intervals", options.share_done(options.most_effects))
    last = judged(with_plain_laws(found, training, options), training)
    while (empty := last.says_nothing(options)) is not None:
        last = judged(without_effect(last.found, empty, training), training)
    found = last.found
    curves = curves_beside_laws(found.point, free, training, options)
    exchange = explaining_columns(balance, start, declared, found.point, training)
    progress("reporting on unseen rows", options.share_done(options.most_effects + 1))
    below = reported, _counted_behind(begins, force_records(noisy, hold, limit_hz, law_hz, more))
    before, after = (_reported(point, records, begins, *below) for point in (declared, found.point))
    stated = stated_noise([r.experiment for r in records]) is not None
    outputs = None if stated else output_error(model.values, declared, train, records, reported)
    return ForceTrace(
        config, places, declared, found, last.errors, last.correlations, last.force_errors,
        before, after, last.rows, last.between, PERCENT * last.unseen, last.left_share,
        last.leaning, last.impossible, exchange, outputs, curves, sd, stated, limit_hz, fitted,
        reported, (
            *notes, *balance.notes, *notes_on_held(found.point, held_for), *table.notes,
            *notes_on_numbers(
                found.point, last.errors, last.impossible.get("", ()), options
            ),
        ), options,
    )  # fmt: skip


def _within_band(covered: Extent, limit_hz: float) -> Extent:
    """Return the range of records whose frequencies a balance below a limit can show.

    A resonance shows below its frequency as compliance: at half of it, a quarter of the mass's
    force. Farther below it is a change of mass, stiffness and damping.
    """
    return replace(covered, fastest_hz=min(covered.fastest_hz, 2.0 * limit_hz))


def _searched_and_told(
    searched: Callable[[Training, Searched | None, int], Searched],
    training: Training,
    begun: Searched | None,
    most: int,
    free: FreeParameters,
    options: SearchOptions,
) -> tuple[Training, Searched]:
    """Return what a search finds, and the records with the weights and scales that this tells.

    searched: a search from a begin, for so many effects. free: all that the model's file leaves
    free.
    """
    found = searched(training, begun, most)
    if found.rated and not training.weighs_what_is_left(found.point, options):
        # What was missing may have been why the weights were refused, or most of them.
        again, point = weighed(training, found.point, found.rated, options)
        if again is not training:
            training, found = again, searched(again, replace(found, point=point), most)
    told = freed_if_told(found.point, free, training, options)
    if told is not None:
        training, point = told
        found = searched(training, replace(found, point=point), most)
    return training, found


def _with_lines(
    covered: Extent, declared: ForceModel, fitted: tuple[ForceRecord, ...], limit_hz: float
) -> Extent:
    """Return the range of records with the lines of the missing force over position and time."""
    periods = position_periods(declared, fitted, limit_hz)
    return replace(
        covered,
        periods=periods.cogging,
        rubbing=periods.rubbing,
        ripples=periods.ripples,
        scales=periods.scales,
        tones_hz=missing_lines(declared, fitted),
    )


def _lacking(
    effects: Callable[[Places, Extent], Sequence[Effect]],
    declared: ForceModel,
    training: Training,
    covered: Extent,
    overlapping: str,
    options: SearchOptions,
) -> SearchedEffects:
    """Return the effects that the records can show and that the declared model lacks."""
    places = training.records[0].signals.places
    table = searched_effects(effects, declared.placed, places, covered, overlapping)
    named = lacked(declared, table.named, training, options)
    named = without_scales(declared, named, training, options.told_from_model)
    return replace(table, named=tuple(named))


def _counted_behind(rows: Sequence[int], whole: Sequence[ForceRecord]) -> tuple[ForceRecord, ...]:
    """Return records that count behind so many rows of each."""
    found = [r.counted_from(begin) for r, begin in zip(whole, rows, strict=True)]
    # Of a DOF that rests in all of them there is nothing better to report.
    still = ~np.any([r.moves.any(axis=0) for r in found], axis=0)
    return tuple(r.counted_at_rest(still) for r in found)


def _reported(
    point: ForceModel,
    records: Sequence[TraceRecord],
    begins: Sequence[int],
    seen: Sequence[ForceRecord],
    noisier: Sequence[ForceRecord],
) -> tuple[ReportedError, ...]:
    """Return the errors of a model on the rows that only report; seen: below the band's limit, and
    with more noise."""
    stated = stated_noise([r.experiment for r in records])
    noise = noise_with_laws(point, seen, noisier)
    each = zip(records, begins, zip(seen, noise, strict=True), strict=True)
    return tuple(reported_error(point, r, begin, below, stated) for r, begin, below in each)


def _noisier(record: TraceRecord, sd: Array, seed: int) -> TraceRecord:
    """Return a record with twice the variance of the outputs' noise, of deviation sd (n,).

    What the noise of motion does to the numbers of a law, as much more of it does once more (Cook
    and Stefanski, *Simulation-extrapolation estimation*, J. Am. Stat. Assoc. 89, 1994).
    """
    e = record.experiment
    more = sd * np.random.default_rng(seed).normal(size=e.y.shape)
    return replace(record, experiment=replace(e, y=e.y + more))


def pooled_errors(trace: ForceTrace) -> tuple[PooledError, PooledError]:
    """Return the errors of all records together, before and after."""
    return PooledError.of(trace.before), PooledError.of(trace.after)
