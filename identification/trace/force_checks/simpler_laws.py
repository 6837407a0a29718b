"""Replace a law by the one that it contains, where the records do not confirm the difference.

A richer law may be taken because its fit began nearer to the truth, and end as a simpler one: a
Stribeck peak of 0 is Coulomb friction. So each simpler law is fitted from the numbers of the richer
one, and the richer one stays only if it is confirmed beside the simpler, as any other effect.

A search asks of a lag how much of it there is, and how long it lasts; of the law as textbooks have
it these are one number. It is held to that where the records do not tell otherwise, and its other
numbers are then better known.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ....model.effects.base import Effect
from ..force_balance.force_record import ForceModel
from ..force_regression.candidate_fit import Beside, fitted_candidate, told_share
from ..force_regression.gauss_newton_fit import fit_numbers
from ..force_regression.intervals import Influences
from ..force_regression.training_records import Training
from ..force_search.compare_fitted_candidates import richer_matters
from ..force_search.rated_candidate import Rated, confirmed, rated_beside
from ..force_search.search import Searched
from ..search_options import SearchOptions
from .certainty_of_effects import with_numbers


def with_simpler_laws(
    found: Searched, named: Sequence[Effect], training: Training, options: SearchOptions
) -> Searched:
    """Return the result with each found law replaced by the simplest that is as good.

    `named` is the table of effects. The model is fitted anew with each law that is replaced.
    """
    for identity in [r.placed.effect.identity for r in found.rated]:
        point = found.point
        own = next(p for p in point.placed if p.effect.identity == identity)
        for law, shape in own.effect.simpler(own.shape, named):
            kept = tuple(p for p in point.placed if p is not own)
            rest = replace(point, placed=kept)
            rated = next(r for r in found.rated if r.placed.effect.identity == identity)
            taken = _as_good(rest, replace(rated, placed=own), law, shape, training, options)
            if taken is not None:
                found = _replaced(found, identity, *taken)
                break
    return found


def with_plain_laws(found: Searched, training: Training, options: SearchOptions) -> Searched:
    """Return the result with each found law held to its textbook form, if the records agree."""
    for identity in [r.placed.effect.identity for r in found.rated]:
        own = next(p for p in found.point.placed if p.effect.identity == identity)
        held = own.as_textbook() or own.at_its_end()
        if held is None:
            continue
        others = tuple(p for p in found.point.placed if p is not own)
        free, plain = (
            fit_numbers(training, replace(found.point, placed=(*others, one)))
            for one in (own, held)
        )
        rated = next(r for r in found.rated if r.placed.effect.identity == identity)
        matters = richer_matters(free, plain, rated, training, options)
        if not matters and not _surely_another(free, training, options):
            found = with_numbers(found, plain)
    return found


def _surely_another(point: ForceModel, training: Training, options: SearchOptions) -> bool:
    """Return whether the last law of a fitted model is surely not in its textbook form.

    By less than a right law's accuracy it may differ.
    """
    free = point.placed[-1]
    textbook = free.as_textbook() or free.at_its_end()
    if textbook is None:
        return False
    freedom = textbook.freedom
    unit = np.eye(len(freedom))
    # Of the way from its textbook form, by its values.
    gradients = unit - freedom @ unit[np.argmax(freedom, axis=0)]
    away = np.abs(np.subtract(free.values, textbook.values))
    covariance = Influences.of(point, training).covariance()[-len(away) :, -len(away) :]
    errors = np.sqrt(np.diag(gradients @ covariance @ gradients.T))
    near = options.alike * np.abs(textbook.values)
    return bool(np.any(away > np.maximum(options.standard_errors * errors, near)))


def _as_good(
    rest: ForceModel,
    richer: Rated,
    law: Effect,
    shape: tuple[float, ...],
    training: Training,
    options: SearchOptions,
) -> tuple[ForceModel, Rated] | None:
    """Return the model with a simpler law, fitted, and its rating; None if the richer one stays."""
    placed = fitted_candidate(Beside.of(rest, training), law, shape, told_share(law, options))
    if placed is None:
        return None
    simple = fit_numbers(training, replace(rest, placed=(*rest.placed, placed)))
    less = simple.placed[-1]
    whole = fit_numbers(training, replace(rest, placed=(*rest.placed, richer.placed)))
    if richer_matters(whole, simple, richer, training, options):
        return None
    without = replace(simple, placed=simple.placed[:-1])
    beside = Beside.of(without, training)
    rated = rated_beside(beside, beside, less, None)
    return (simple, rated) if confirmed(rated, options) else None


def _replaced(found: Searched, identity: str, point: ForceModel, rated: Rated) -> Searched:
    last = {p.effect.identity: p for p in point.placed}
    result = []
    for one in found.rated:
        if one.placed.effect.identity != identity:
            result.append(replace(one, placed=last[one.placed.effect.identity]))
            continue
        own = rated.placed.effect.identity
        others = tuple(a for a in one.alternatives if a.placed.effect.identity != own)
        result.append(replace(rated, support=one.support, alternatives=others))
    return replace(found, point=point, rated=tuple(result))
