"""Judge how sure found effects are: errors of their numbers, what is left with each, whether it may
be zero."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ...covariance_scaling import correlation
from ...rounding import TINY
from ..force_balance.force_record import ForceModel, ForceRecord
from ..force_balance.free_numbers import numbers
from ..force_balance.noise_through_laws import noise_with_laws
from ..force_balance.richest_free_form import foretold, residual_of_richest
from ..force_regression.candidate_fit import Beside, taken_at, told_share
from ..force_regression.gauss_newton_fit import fit_numbers
from ..force_regression.intervals import Influences, Uncertainty, relative_force_errors
from ..force_regression.training_records import Training, missing_share
from ..force_search.scale_of_equations import explained_by_any_form
from ..force_search.search import Searched
from ..search_options import SearchOptions
from .impossible_matrices import impossible_matrices
from .instrumental_variables import Unbiased

Array = NDArray[np.float64]


@dataclass(frozen=True)
class FittedRows:
    """What is missing in the fitted rows over the force of the inputs, by DOF (n,).

    missing: of the model. form: of a free form of all signals, nan where all terms of an equation
    are free. noise: what of it the noise of the outputs gives.
    """

    missing: Array
    form: Array
    noise: Array

    @classmethod
    def of(
        cls,
        point: ForceModel,
        training: Training,
        own: Sequence[Array],
        noise: Sequence[Array],
        told_from_model: float,
    ) -> FittedRows:
        """Return what a model with columns `own` (C, rows, n), without weights, leaves of each
        training record. noise: what that of the outputs gives in each (n,)."""
        records = training.records
        force = np.maximum(_rms([r.acting_force(point) for r in records]), TINY)
        missing = _rms([r.varying(r.missing_force(point)) for r in records])
        left = _rms(residual_of_richest(point, records, own, unlisted=True))
        pooled = _pooled(noise, records)
        empty = explained_by_any_form(point, training, told_from_model)
        form = np.where(empty, np.nan, left)
        return cls(missing / force, form / force, pooled / force)

    @property
    def any_law(self) -> Array:
        """What any law leaves (n,): no less than a free form, nor than the noise."""
        return np.maximum(self.form, self.noise)


@dataclass(frozen=True)
class Certainty:
    """How sure what was found is: fields of ForceTrace."""

    found: Searched
    errors: Array
    correlations: Array
    force_errors: list[Array]
    unseen: Array
    rows: FittedRows
    between: FittedRows | None
    left_share: tuple[float, ...]
    takes: tuple[bool, ...]
    leaning: tuple[float, ...]
    impossible: Mapping[str, tuple[str, ...]]

    @classmethod
    def of(
        cls,
        found: Searched,
        fitted: Sequence[ForceRecord],
        training: Training,
        others: Sequence[Training],
        options: SearchOptions,
        declared: Mapping[str, float],
        unbiased: Unbiased | None = None,
        parts: Sequence[Training] = (),
    ) -> Certainty:
        """Judge the result of a search; `others`: in other bands, the last with more noise.

        declared: values of the parameters in the model file.
        parts: the records of `training` with some of their rows, where the equation is better.
        unbiased: the model fitted with instruments, whose numbers take the place of the found ones
        where these miss more force than the error of an equation.
        """
        base = numbers(found.point)
        richer = _with_what_came_near(found, training, options)
        members = _with_another_member(found, training)
        moved = [numbers(model)[: len(base)] - base for model in richer]
        if unbiased is None or not unbiased.large:
            point, instruments = found.point, None
            moved += [numbers(fit_numbers(other, point)) - base for other in others]
            moved += [_beyond_chance(point, training, part) for part in parts]
            moved += [] if unbiased is None else [numbers(unbiased.point) - base]
        else:
            point, instruments = unbiased.point, unbiased.instruments
            moved += [numbers(other) - numbers(point) for other in unbiased.others]
        of_point = Uncertainty.of(point, training, moved, instruments)
        uncertainty = of_point.with_more(members)
        whole = Beside.of(found.point, training)
        told = options.told_from_model
        noisier = others[-1].records
        noise = noise_with_laws(found.point, training.records, noisier)
        rows = FittedRows.of(found.point, training, whole.plain.own, noise, told)
        between = []
        for part in parts:
            own = Beside.of(found.point, part).plain.own
            noise = noise_with_laws(found.point, part.records, noisier)
            between.append(FittedRows.of(found.point, part, own, noise, told))
        force = np.maximum(_rms([r.acting_force(found.point) for r in fitted]), TINY)
        force_errors = relative_force_errors(point, fitted, of_point)
        left_share, takes = _left_share(found, training, rows.noise, options)
        impossible = impossible_matrices(
            with_numbers(found, point), declared, training, of_point, options
        )
        return cls(
            with_numbers(found, point),
            uncertainty.standard_errors(),
            correlation(uncertainty.covariance),
            force_errors,
            foretold(found.point, fitted, whole.plain.own, options.fewest_blocks) / force,
            rows,
            between[0] if between else None,
            left_share,
            takes,
            _leaning(found, training, rows.noise, options, left_share, force_errors, impossible),
            impossible,
        )

    def says_nothing(self, options: SearchOptions) -> str | None:
        """Return the effect, by identity, that may be zero, and takes nothing or leaves much.

        None if there is no such one. What leaves much is in doubt, and what may be zero as well was
        not found: another effect has taken its place, its fit has moved the model, or it stands for
        something that is no law of the table.
        """
        errors = {
            p.effect.identity: own
            for p, own in zip(self.found.point.placed, self.force_errors, strict=True)
        }
        for rated, left, takes in zip(self.found.rated, self.left_share, self.takes, strict=True):
            identity = rated.placed.effect.identity
            idle = left > options.least_gain or not takes
            if not rated.free and idle and not is_told(errors[identity], options):
                return identity
        return None


def is_told(force_errors: Array, options: SearchOptions) -> bool:
    """Return whether one of an effect's forces, of these relative errors (amplitudes,), is told
    from zero."""
    return bool(np.any(options.standard_errors * force_errors < 1.0))


def without_effect(found: Searched, identity: str, training: Training) -> Searched:
    """Return the result without an effect, the model fitted again."""
    kept = tuple(p for p in found.point.placed if p.effect.identity != identity)
    left = tuple(r for r in found.rated if r.placed.effect.identity != identity)
    less = replace(found, rated=left, dropped=(*found.dropped, identity))
    return with_numbers(less, fit_numbers(training, replace(found.point, placed=kept)))


def with_numbers(found: Searched, point: ForceModel) -> Searched:
    """Return the result with the numbers of a point that has the same effects."""
    last = {p.effect.identity: p for p in point.placed}
    rated = tuple(replace(r, placed=last[r.placed.effect.identity]) for r in found.rated)
    return replace(found, point=point, rated=rated)


def _beyond_chance(point: ForceModel, whole: Training, part: Training) -> Array:
    """Return the changes of all numbers (K,) by a fit to a part of the rows, less what is chance.

    The difference of two fits, one of which has all rows, has the difference of their variances
    (Hausman, *Specification tests in econometrics*, Econometrica 46, 1978). A part tells nothing of
    numbers that change no force there.
    """
    change = numbers(fit_numbers(part, point)) - numbers(point)
    own, all_rows = (Influences.of(point, training) for training in (part, whole))
    chance = np.diag(own.covariance()) - np.diag(all_rows.covariance())
    beyond = np.maximum(change**2 - np.maximum(chance, 0.0), 0.0)
    return np.where(own.silent, 0.0, np.copysign(np.sqrt(beyond), change))


def _with_what_came_near(
    found: Searched, training: Training, options: SearchOptions
) -> list[ForceModel]:
    """Return the fitted models with each effect that is no chance, but was too small to be added.

    It may be there: the numbers of what was found are not better known than it changes them. What
    would be there instead of an effect found, as its alternative, is not there beside it. If the
    model misses more force with it, it lowers what has weights alone: with an actuator that is
    turned round, the controller is a plant that explains what a loop answers to a random force.
    """
    known = {p.effect.identity for p in found.point.placed}
    known |= {a.placed.effect.identity for r in found.rated for a in r.alternatives}
    near = [
        r.placed
        for r in found.nearest
        if not r.free
        and r.gain.elsewhere
        and r.gain.statistic > options.standard_errors
        and r.share > options.least_gain
        and r.placed.effect.identity not in known
    ]
    more = [replace(found.point, placed=(*found.point.placed, placed)) for placed in near]
    plain = training.plain
    before = np.linalg.norm(missing_share(plain.at(found.point)))
    fitted = [fit_numbers(training, point) for point in more]
    return [
        p
        for p in fitted
        if np.linalg.norm(missing_share(plain.at(p))) < before
        and _last_is_told(p, training, options)
    ]


def _last_is_told(point: ForceModel, training: Training, options: SearchOptions) -> bool:
    """Return whether the last effect of a fitted model is none of its parameters by another name.

    A fit may end there: a damping that falls at far higher speeds only is the declared one.
    """
    *others, last = point.placed
    beside = Beside.of(replace(point, placed=tuple(others)), training)
    told = told_share(last.effect, options)
    return taken_at(beside, last.effect, last.shape, told) is not None


def _with_another_member(found: Searched, training: Training) -> list[Array]:
    """Return the changes of all numbers (K,) by each alternative in the place of its effect.

    Records that do not separate an effect from another one do not determine the model's numbers and
    those of other effects beyond what both give. The replaced effect has no number in the other
    model, so its own do not change.
    """
    point, own = found.point, numbers(found.point)
    changes = []
    for rated in found.rated:
        for other in rated.alternatives:
            identity = rated.placed.effect.identity
            at = next(i for i, p in enumerate(point.placed) if p.effect.identity == identity)
            placed = (*point.placed[:at], other.placed, *point.placed[at + 1 :])
            fitted = fit_numbers(training, replace(point, placed=placed))
            kept = (*fitted.placed[:at], point.placed[at], *fitted.placed[at + 1 :])
            changes.append(numbers(replace(fitted, placed=kept)) - own)
    return changes


def _left_share(
    found: Searched, training: Training, noise: Array, options: SearchOptions
) -> tuple[tuple[float, ...], tuple[bool, ...]]:
    """Return for each effect the share of the squared missing force without it, the others fitted
    again, that is left with it, at the DOF where it takes most, and whether it takes what matters.

    noise (n,): what that of the outputs gives, over the acting force; only what is beyond it
    counts, and only if an effect must take as much. A free form that leaves more tells nothing: it
    may lack what the table lacks.
    """
    plain = training.plain

    def missing(point: ForceModel) -> Array:
        return missing_share(plain.at(point))

    after = missing(found.point)
    beyond = np.where(after - noise > options.least_force, after**2 - noise**2, 0.0)
    shares, takes = [], []
    for rated in found.rated:
        identity = rated.placed.effect.identity
        others = tuple(p for p in found.point.placed if p.effect.identity != identity)
        without = missing(fit_numbers(training, replace(found.point, placed=others)))
        taken = without**2 - after**2
        most = int(np.argmax(taken))
        there = beyond[most] + max(float(taken[most]), 0.0)
        shares.append(float(beyond[most] / there) if there > 0.0 else 0.0)
        takes.append(bool(np.any(without - after > options.least_force)))
    return tuple(shares), tuple(takes)


def _leaning(
    found: Searched,
    training: Training,
    noise: Array,
    options: SearchOptions,
    left_share: Sequence[float],
    force_errors: Sequence[Array],
    impossible: Mapping[str, tuple[str, ...]],
) -> tuple[float, ...]:
    """Return for each effect what `_left_share` says of the model without the effects in doubt.

    Where others are in doubt it may be right only together with them: so it has to be right without
    them. 0 for those in doubt, if none is, and for free forms, which are no names.
    """
    errors = {p.effect.identity: e for p, e in zip(found.point.placed, force_errors, strict=True)}
    shares = {
        r.placed.effect.identity: share
        for r, share in zip(found.rated, left_share, strict=True)
        if not r.free
    }
    doubtful = {
        one
        for one, share in shares.items()
        if share > options.least_gain
        or not is_told(errors[one], options)
        or impossible.get(one, ())
    }
    leaning = dict.fromkeys(shares, 0.0)
    while doubtful and len(doubtful) < len(shares):
        kept = tuple(p for p in found.point.placed if p.effect.identity not in doubtful)
        rated = tuple(r for r in found.rated if r.placed.effect.identity not in doubtful)
        sure = with_numbers(
            replace(found, rated=rated), fit_numbers(training, replace(found.point, placed=kept))
        )
        more = set()
        for r, share in zip(rated, _left_share(sure, training, noise, options)[0], strict=True):
            if not r.free and share > options.least_gain:
                leaning[r.placed.effect.identity] = share
                more.add(r.placed.effect.identity)
        if not more:
            break
        doubtful |= more
    return tuple(leaning.get(r.placed.effect.identity, 0.0) for r in found.rated)


def _rms(values: Sequence[Array]) -> Array:
    return np.asarray(np.sqrt(np.mean(np.concatenate(list(values)) ** 2, axis=0)))


def _pooled(rms: Sequence[Array], records: Sequence[ForceRecord]) -> Array:
    """Return the RMS over all rows (n,) of those of each record."""
    rows = np.array([r.rows for r in records])
    return np.asarray(np.sqrt(rows @ np.square(rms) / rows.sum()))
