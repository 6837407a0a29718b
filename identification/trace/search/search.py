"""Search for effects: screening, fitting, and confirmation on held-out records."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from ....model.effects.base import Effect
from ...covariance_scaling import correlation
from ...records.record import IdentificationError
from ..linearised.linearisation_point import WorkingPoint
from ..search_options import SearchOptions
from .backward_elimination import without_guesses, without_idle
from .effects_not_told_apart import supports, with_equals
from .forward_selection import Grown, Progress, grown
from .gauss_newton import FULLY, gather, refine
from .hold_amplitudes_at_one import free_numbers, with_plain_amplitudes
from .predictive_criterion import is_worse
from .regression import ColumnEvidence, covariance, standard_errors
from .replace_effect_by_rival import otherwise
from .tested_candidate import Records, Round, TimeOverError

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Found:
    """The final working point, the rounds, and the residuals of training and held-out records.

    errors (P,): standard errors of [the model's parameters over scale, amplitudes and shapes]; nan
    of what is held. correlations (P, P): of these numbers, 0 of what is held. supports: by
    identity, share of resamples of the blocks that choose an effect.
    """

    point: WorkingPoint
    rounds: tuple[Round, ...]
    errors: Array
    correlations: Array
    train: ColumnEvidence
    held: ColumnEvidence
    supports: Mapping[str, float] = field(default_factory=dict)


def search(
    point: WorkingPoint,
    effects: Sequence[Effect],
    unknown: Sequence[Effect],
    records: Records,
    progress: Progress,
    options: SearchOptions,
) -> Found:
    """Search for effects by forward selection, with confirmation on held-out records.

    `point` is at its best already. Where much is left in the end another way is tried, and then
    free-form forces (`unknown`); a name whose place they can take was a guess, and is dropped.
    When the records' time is over, it returns what was confirmed before, and nothing is fitted any
    more: the standard errors are those of the last fit.
    """
    error = records.in_any_time().held_error(point)
    if not np.isfinite(error.floor) or np.isnan(error.squares):
        raise IdentificationError(
            "expected a model whose free-run simulation of the held-out records is finite, found "
            f"a diverging one (mean square error {error.squares:.3g}, noise {error.floor:.3g}); "
            "trace an unstable plant in closed loop"
        )
    begun = Grown(point, error, ())
    found = grown(begun, effects, options.most_effects, 0.0, records, progress, options)
    if found.much_left(options):
        more = options.most_effects - len(found.point.placed) + len(point.placed)
        found = otherwise(found, effects, more, records, progress, options)
    if found.much_left(options):
        described = grown(
            found._replace(rounds=()),
            unknown,
            options.most_effects,
            options.much_left**2,
            records,
            progress,
            options,
        )
        rounds = (*found.rounds, *described.rounds)
        found = found._replace(rounds=rounds)
        if described.point is not found.point:
            with suppress(TimeOverError):
                point = without_guesses(described.point, records, options)
                found = Grown(point, records.held_error(point), rounds)
    with suppress(TimeOverError):
        found = _settled(found, effects, records, options)
    return _with_residuals(found, records.in_any_time(), options)


def _settled(
    reached: Grown, effects: Sequence[Effect], records: Records, options: SearchOptions
) -> Grown:
    """Fit the point to convergence, and compare its effects with those that fit as well."""
    point, error, rounds = reached
    # What was fitted last was so while it was not known whether more would come.
    fitted, _ = refine(point, records, within=FULLY)
    # Noise that is not measured was estimated of a fit that had not converged.
    likely = records.with_estimated_noise(fitted)
    if likely is not fitted:
        fitted, _ = refine(likely, records, within=FULLY)
    if not is_worse(records.held_error(fitted), error, options):
        point = fitted
    plain = with_plain_amplitudes(point, records, options)
    if plain is not point and not is_worse(records.held_error(plain), error, options):
        point = plain
    point, rounds = with_equals(
        without_idle(point, records, options), rounds, effects, records, options
    )
    return Grown(point, error, rounds)


def _with_residuals(reached: Grown, records: Records, options: SearchOptions) -> Found:
    """Return the point with standard errors and residuals."""
    point, _, rounds = reached
    train, held = (gather(point, part) for part in (records.train(point), records.held(point)))
    free = free_numbers(point)
    errors = np.full(len(free), np.nan)
    errors[free] = standard_errors(train, np.flatnonzero(free))
    correlations = np.eye(len(free))
    correlations[np.ix_(free, free)] = correlation(covariance(train.whole, np.flatnonzero(free)))
    chosen = supports(point, train, options)
    point = _with_errors(point, errors)
    return Found(point, rounds, errors, correlations, train, held, supports=chosen)


def _with_errors(point: WorkingPoint, errors: Array) -> WorkingPoint:
    """Return the point with the standard errors of its effects."""
    at, placed = len(point.parameters.names), []
    for p in point.placed:
        names = [q.name for q in (*p.effect.amplitudes, *p.effect.shape)]
        own = errors[at : at + len(names)]
        placed.append(replace(p, standard_errors=dict(zip(names, own.tolist(), strict=True))))
        at += len(names)
    return replace(point, placed=tuple(placed))
