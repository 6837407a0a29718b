"""Remove effects by backward elimination: stand-ins, guesses, and effects made redundant.

What the model loses without an effect, fitted again, decides by the numbers of the search options.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ....model.effects.base import Placed
from ..linearised.linearisation_point import WorkingPoint
from ..search_options import SearchOptions
from .gauss_newton import NEARLY, Fitted, gather, refine
from .regression import ColumnEvidence, cross_validated, steadied
from .tested_candidate import Round, Tried, numbers

Array = NDArray[np.float64]


def without_stand_in(
    point: WorkingPoint,
    squares: float,
    taken: Tried,
    rounds: Sequence[Round],
    records: Fitted,
    options: SearchOptions,
) -> tuple[WorkingPoint, float, int | None]:
    """Remove an earlier effect that the new one replaces; return the point and the round.

    Two that fitted alike to all that was there may differ in what is left: where the second is
    taken too, it may be enough by itself, begun as it fitted then.
    """
    for number, earlier in enumerate(rounds):
        rival = _rival(earlier, taken.effect.identity)
        if earlier.taken is None or rival is None:
            continue
        both = {taken.effect.identity, earlier.taken.effect.identity}
        others = tuple(p for p in point.placed if p.effect.identity not in both)
        if len(others) != len(point.placed) - 2:
            continue  # it has been given up since
        alone, left = refine(replace(point, placed=(*others, rival.placed)), records, within=NEARLY)
        if left - squares < max(options.another_law * earlier.excess, options.least_squares):
            return alone, left, number
    return point, squares, None


def without_guide(
    point: WorkingPoint, squares: float, before: float, records: Fitted, options: SearchOptions
) -> WorkingPoint | None:
    """Remove the last effect if it only served to find the others.

    A fit ends in the valley that it began in. Beside another effect what was found before may come
    out of it, and then needs no other; without shapes there is one valley only. None if more is
    lost without it than an effect must take of `before`, the squared errors above noise before it.
    """
    *others, _ = point.placed
    if not any(p.shape for p in others):
        return None
    alone, left = refine(replace(point, placed=tuple(others)), records, within=NEARLY)
    return alone if left - squares < options.least_gain * before else None


def taken_instead(found: Round, identity: str) -> Round:
    """Return the round with an alternative accepted, and the accepted effect as an alternative."""
    rival = _rival(found, identity)
    assert found.taken is not None
    others = (t for t in found.alternatives if t is not rival)
    return replace(found, taken=rival, alternatives=(found.taken, *others))


def without_guesses(point: WorkingPoint, records: Fitted, options: SearchOptions) -> WorkingPoint:
    """Remove named effects that free-form forces make redundant."""
    named = [p.effect.identity for p in point.placed if p.effect.effect_class != "unknown"]
    best = gather(point, records.train(point))
    for guess in named:
        others = tuple(p for p in point.placed if p.effect.identity != guess)
        fewer = replace(point, placed=others)
        fewer, squares = refine(fewer, records, within=NEARLY)
        if squares - best.squares < max(
            options.least_free_gain * best.excess, options.least_squares
        ):
            point, best = fewer, gather(fewer, records.train(fewer))
    return point


def without_idle(point: WorkingPoint, records: Fitted, options: SearchOptions) -> WorkingPoint:
    """Remove effects that later ones make redundant.

    One by one: two that stand in for each other are not both idle.
    """
    while len(point.placed) > 1:
        fewer = _without_the_idlest(point, records, options)
        if fewer is None:
            break
        point = fewer
    return point


def brought(point: WorkingPoint, train: ColumnEvidence) -> list[float]:
    """Return the increase of squared errors without each effect, the others refitted."""
    return [float(cost.sum()) for cost in removal_costs(point, train)]


def removal_costs(point: WorkingPoint, train: ColumnEvidence) -> list[Array]:
    """Return what each effect takes of the squared errors of each block (B,), as `brought`."""
    train = steadied(train)
    at, base = len(point.parameters.names), list(range(train.gram.shape[1] - 1))
    full = cross_validated(train, base)
    costs = []
    for p in point.placed:
        own = set(range(at, at + numbers(p.effect)))
        # Without it its errors come back: what its own columns would have to explain again.
        back = _restored(train, p, sorted(own), len(p.amplitudes))
        kept = [c for c in base if c not in own]
        costs.append(cross_validated(back, kept) - full)
        at += numbers(p.effect)
    return costs


def restoring(
    evidence: ColumnEvidence, columns: Sequence[int], amplitudes: Sequence[float]
) -> Array:
    """Return the matrix (Q, Q) that sets amplitudes to zero in [columns, errors], first order."""
    take = np.eye(len(evidence.size))
    take[columns, -1] = -np.array(amplitudes) * evidence.size[columns]
    return take


def without_effect(
    train: ColumnEvidence, columns: Sequence[int], amplitudes: Sequence[float]
) -> ColumnEvidence:
    """Return the evidence without the columns of an effect, its errors restored, first order.

    `amplitudes` are those of the first columns.
    """
    kept = np.delete(np.arange(len(train.size)), columns)
    take = restoring(train, columns[: len(amplitudes)], amplitudes)[:, kept]
    return replace(
        train,
        gram=np.einsum("ji,bjk,kl->bil", take, train.gram, take, optimize=True),
        size=train.size[kept],
        prior=take.T @ train.prior @ take,
        beside=tuple(
            replace(b, cross=np.einsum("ji,bjg->big", take, b.cross)) for b in train.beside
        ),
    )


def columns_of(point: WorkingPoint, placed: Placed) -> list[int]:
    """Return the columns of an effect of the point: amplitudes, then shape."""
    at = len(point.parameters.names)
    for p in point.placed:
        if p is placed:
            return list(range(at, at + numbers(p.effect)))
        at += numbers(p.effect)
    raise ValueError(f"expected an effect of the point, found {placed.effect.identity}")


def _without_the_idlest(
    point: WorkingPoint, records: Fitted, options: SearchOptions
) -> WorkingPoint | None:
    """Remove the least important effect and refit; None if all are important."""
    costs = brought(point, gather(point, records.train(point)))
    least = int(np.argmin(costs))
    if costs[least] >= options.least_squares:
        return None
    others = point.placed[:least] + point.placed[least + 1 :]
    return refine(replace(point, placed=others), records, within=NEARLY)[0]


def _rival(found: Round, identity: str) -> Tried | None:
    """Return the alternative with this identity, or None."""
    return next((t for t in found.alternatives if t.effect.identity == identity), None)


def _restored(
    evidence: ColumnEvidence, placed: Placed, own: Sequence[int], amplitudes: int
) -> ColumnEvidence:
    """Return the evidence with an effect's amplitudes set to zero, to first order."""
    take = restoring(evidence, list(own)[:amplitudes], placed.amplitudes)
    gram = np.einsum("ji,bjk,kl->bil", take, evidence.gram, take, optimize=True)
    return replace(evidence, gram=gram, prior=take.T @ evidence.prior @ take)
