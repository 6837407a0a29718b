"""Screen candidates by regression, fit the shapes of the best ones, and test these.

A candidate whose shape is a first guess explains little of what it does at the right one. So its
shape is fitted before any question is asked: the best ones at once, and the next best ones if none
of these is taken.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from ..linearised.linearisation_point import WorkingPoint
from ..search_options import SearchOptions
from .gauss_newton import Candidate
from .predictive_criterion import HALF, Criterion, tested
from .regression import ColumnEvidence, gains, solve
from .separable_least_squares import with_fitted_shapes
from .tested_candidate import Records, Round, Tried, is_product, numbers

_VALLEYS = 2
"""From how many other shapes of its grid an effect is fitted too: from those that gain half as much
as the best one; where something happened once, a time that is not nearest tells nothing."""
_PRICE = 2.0
"""Squared errors that a number must save, by Akaike's criterion."""


def screened(
    point: WorkingPoint,
    candidates: Sequence[Candidate],
    train: ColumnEvidence,
    records: Records,
    criterion: Criterion,
    is_open: Callable[[Tried], bool],
) -> Round:
    """Return a round with the best candidate that the criterion takes, and its equals.

    The candidates' columns are in `train` in their order, behind those of the point. Nothing is
    taken that is not open.
    """
    options = criterion.options
    ranked = _ranked(candidates, train, options)
    asked: list[Tried] = []
    survivors: list[Tried] = []
    for first in range(0, len(ranked), options.fitted):
        some = ranked[first : first + options.fitted]
        if first and not any(criterion.may_take(one[0]) for one in some):
            break
        asked += tested(point, _fitted(point, some, records), records, options)
        survivors = [t for t in asked if criterion.takes(t) and is_open(t)]
        if survivors:
            break
    asked.sort(key=partial(worth, options=options), reverse=True)
    survivors.sort(key=partial(worth, options=options), reverse=True)
    found = Round(train.excess, float(train.count.sum()), tuple(asked), tuple(survivors), None, ())
    return found if not survivors else _taken(found, options)


def worth(tried: Tried, options: SearchOptions) -> float:
    """Return what a candidate gains beyond the price of its numbers.

    A product of two signals has room for what one of them does alone, and for chance: what it gains
    more than that has to be worth describing by itself.
    """
    share = 1.0 - options.least_gain if is_product(tried.effect) else 1.0
    return share * tried.gain - _PRICE * numbers(tried.effect)


def told_apart(tried: Tried, best: Tried, options: SearchOptions, left: float = 0.0) -> bool:
    """Return whether a candidate gains so much less than another one that it need not be fitted.

    `left`: the squared errors above noise that nothing explains; two that differ by less than the
    accuracy of an equation of these may change places once they are explained.
    """
    near = max(options.alike * best.gain, options.least_squares, options.accuracy * left)
    return best.gain - tried.gain >= near


def regressed(train: ColumnEvidence, number: int, tried: Tried) -> tuple[Tried, bool]:
    """Return candidate `number` of the evidence with its amplitudes by regression.

    Also whether these are within their bounds. Too much of an effect with a shape may be the right
    one of another shape; a friction that drives is none.
    """
    joined, effect = train.joined(number), tried.effect
    found = solve(joined.whole, list(range(len(joined.size) - 1))) / joined.size[:-1]
    pairs = list(zip(found[-len(effect.amplitudes) :], effect.amplitudes, strict=True))
    inside = all(q.low <= a and (effect.shape or a <= q.high) for a, q in pairs)
    amplitudes = tuple(float(np.clip(a, q.low, q.high)) for a, q in pairs)
    return Tried(effect, tried.shape, tried.gain, tried.blocks, amplitudes), bool(inside)


def _ranked(
    candidates: Sequence[Candidate], train: ColumnEvidence, options: SearchOptions
) -> list[list[Tried]]:
    """Return the best candidates, each at the shapes of its grid that explain most of all."""
    by_gain = [
        Tried(effect, shape, float(blocks.sum()), blocks, ())
        for (effect, shape), blocks in zip(candidates, gains(train), strict=True)
    ]
    order = [i for i in range(len(candidates)) if np.isfinite(by_gain[i].gain)]
    order.sort(key=lambda i: -worth(by_gain[i], options))
    ranked: dict[str, list[Tried]] = {}
    for i in order:
        identity = by_gain[i].effect.identity
        valleys = ranked.get(identity, [])
        full = len(ranked) >= options.shortlisted
        if len(valleys) > _VALLEYS or (full and not valleys):
            continue
        if valleys and by_gain[i].gain <= HALF * valleys[0].gain:
            continue
        tried, inside = regressed(train, i, by_gain[i])
        if inside:
            ranked.setdefault(identity, []).append(tried)
    return list(ranked.values())


def _fitted(point: WorkingPoint, some: Sequence[Sequence[Tried]], records: Records) -> list[Tried]:
    """Return each candidate at the best shape that a fit from any of its valleys reaches."""
    best: dict[str, Tried] = {}
    for t in with_fitted_shapes(point, [t for one in some for t in one], records):
        before = best.get(t.effect.identity)
        if np.isfinite(t.gain) and (before is None or t.gain > before.gain):
            best[t.effect.identity] = t
    return list(best.values())


def _taken(found: Round, options: SearchOptions) -> Round:
    """Return the round with its first survivor taken, and those that gain nearly as much.

    Along fixed trajectories a gain is known less accurately than from a fit of the whole model: two
    may differ by twice as much as in `told_apart`.
    """
    winner = found.survivors[0]
    left = options.accuracy * (found.excess - winner.gain)
    near = max(2.0 * options.alike * winner.gain, options.least_squares, left)
    alike = [
        t
        for t in found.ranking
        if t.effect.identity != winner.effect.identity
        and (t.shape or t.effect.effect_class != "unknown")
        and worth(winner, options) - worth(t, options) < near
    ]
    return replace(found, taken=winner, alternatives=tuple(alike[: options.most_effects]))
