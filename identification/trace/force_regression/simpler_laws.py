"""Replace a law by the one that it contains, where the records do not confirm the difference.

A richer law may be taken because its fit began nearer to the truth, and end as a simpler one: a
Stribeck peak of 0 is Coulomb friction. So each simpler law is fitted from the numbers of the richer
one, and the richer one stays only if it is confirmed beside the simpler, as any other effect.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from ....model.effects.base import Effect
from ..search_options import SearchOptions
from .candidate_fit import Beside, fitted_candidate
from .compare_fitted_candidates import richer_matters
from .force_record import ForceModel
from .rated_candidate import Rated, confirmed, rated_beside
from .search import Searched
from .training_records import Training


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


def _as_good(
    rest: ForceModel,
    richer: Rated,
    law: Effect,
    shape: tuple[float, ...],
    training: Training,
    options: SearchOptions,
) -> tuple[ForceModel, Rated] | None:
    """Return the model with a simpler law, fitted, and its rating; None if the richer one stays."""
    placed = fitted_candidate(Beside.of(rest, training), law, shape, options.told_from_model)
    if placed is None:
        return None
    simple = training.fit(replace(rest, placed=(*rest.placed, placed)))
    less = simple.placed[-1]
    whole = training.fit(replace(rest, placed=(*rest.placed, richer.placed)))
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
