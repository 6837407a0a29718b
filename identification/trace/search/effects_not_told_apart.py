"""Find the effects that the records do not tell apart, beside all others that were found.

An effect that was accepted early was compared with its rivals while others were missing. At the end
each rival is fitted in its place, all numbers of the model with it, and the squared errors of the
blocks decide: if their sum differs by no more than its scatter over the blocks, no data of this
session prefer one of the two. The simplest that is not surely worse than the best stays in the
model.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ....model.declared_model import ModelError
from ....model.effects.base import Effect, Placed
from ...records.record import IdentificationError
from ..linearised.linearisation_point import WorkingPoint
from ..search_options import SearchOptions
from .backward_elimination import removal_costs
from .candidate_screening import told_apart
from .equivalent_candidates import equivalents
from .gauss_newton import FULLY, gather, refine
from .predictive_criterion import is_worse, tested
from .regression import ColumnEvidence
from .separable_least_squares import with_fitted_shapes
from .tested_candidate import Records, Round, Tried, numbers

Array = NDArray[np.float64]

_NOTHING = 1.0
"""Squared errors that differ by less are the same: one number fits as much noise."""


@dataclass(frozen=True)
class Member:
    """An effect in the place of another one, fitted, with the squared errors of the blocks (B,)."""

    tried: Tried
    point: WorkingPoint
    squares: Array


def with_equals(
    point: WorkingPoint,
    rounds: Sequence[Round],
    effects: Sequence[Effect],
    records: Records,
    options: SearchOptions,
) -> tuple[WorkingPoint, tuple[Round, ...]]:
    """Return the point and the rounds, each accepted effect with those not told from it.

    `point` is fitted to convergence. Rivals are those of the round in which it was accepted, those
    of `effects` that are equivalent to it beside all others, and the simpler laws that it contains:
    with a peak of 0, Stribeck friction is Coulomb friction. Where a simpler effect is not told from
    an accepted one, it takes its place.
    """
    checked, later = list(rounds), equivalents(point, effects, records, options)
    left = gather(point, records.train(point)).excess
    for number, one in enumerate(checked):
        taken = one.taken
        own = None if taken is None else _placed(point, taken.effect)
        if taken is None or own is None:
            continue
        both = (
            *one.alternatives,
            *later.get(taken.effect.identity, ()),
            *_simpler(own, effects),
        )
        rivals = {t.effect.identity: t for t in both}
        if not rivals:
            continue
        some = alike_along(point, taken.effect, tuple(rivals.values()), records, options, left)
        equals = _equals(in_place(point, taken, some, records), records, options, left)
        if equals[0].tried.effect is not taken.effect:
            taken = _in_its_place(equals[0], taken, records, options)
        point = equals[0].point
        checked[number] = replace(
            one,
            taken=taken,
            alternatives=tuple(m.tried for m in equals[1:]),
            shares=_shares([m.squares for m in equals], options.resamples),
        )
    return point, tuple(checked)


def _simpler(placed: Placed, effects: Sequence[Effect]) -> list[Tried]:
    """Return the simpler laws that an effect contains, with its amplitudes and shape.

    A fit of an amplitude that has another name begins at zero.
    """
    values = dict(zip((q.name for q in placed.effect.amplitudes), placed.amplitudes, strict=True))
    return [
        Tried(law, shape, 0.0, np.zeros(1), tuple(values.get(q.name, 0.0) for q in law.amplitudes))
        for law, shape in placed.effect.simpler(placed.shape, effects)
    ]


def _equals(
    members: Sequence[Member], records: Records, options: SearchOptions, left: float
) -> list[Member]:
    """Return what is not told apart; nothing takes a place with a surely larger free-run error.

    The first member is the accepted effect, which stays then.
    """
    some, own = list(members), members[0]
    while True:
        equals = not_told_apart(some, options, left)
        first = equals[0]
        if first is own or not is_worse(
            records.held_error(first.point), records.held_error(own.point), options
        ):
            return equals
        some = [m for m in some if m is not first]


def _in_its_place(member: Member, taken: Tried, records: Records, options: SearchOptions) -> Tried:
    """Return a member with the gain of the effect that it replaces, asked as that one was."""
    placed = _placed(member.point, member.tried.effect)
    assert placed is not None
    others = tuple(p for p in member.point.placed if p is not placed)
    tried = Tried(placed.effect, placed.shape, taken.gain, taken.blocks, placed.amplitudes)
    return tested(replace(member.point, placed=others), [tried], records, options)[0]


def alike_along(
    point: WorkingPoint,
    effect: Effect,
    rivals: Sequence[Tried],
    records: Records,
    options: SearchOptions,
    left: float = 0.0,
) -> list[Tried]:
    """Return the rivals of an effect of the point that explain about as much in its place.

    Their shapes are fitted along the trajectories with that effect, beside all others.
    """
    own = _placed(point, effect)
    assert own is not None
    there = {p.effect.identity for p in point.placed}
    asked = [t for t in rivals if t.effect.identity not in there]
    if not asked:
        return []
    start = Tried(own.effect, own.shape, 0.0, np.zeros(1), own.amplitudes)
    itself, *others = with_fitted_shapes(point, [start, *asked], records, own)
    return [t for t in others if not told_apart(t, itself, options, left)]


def in_place(
    point: WorkingPoint, taken: Tried, rivals: Sequence[Tried], records: Records
) -> list[Member]:
    """Return an effect of the point and its rivals, each fitted in its place, itself too.

    Rivals that cannot be fitted, or that act already, are left out.
    """
    if rivals:  # a fit that is nearly done would lose against one that is
        point, _ = refine(point, records, within=FULLY)
    own = _placed(point, taken.effect)
    assert own is not None
    taken = replace(taken, shape=own.shape, amplitudes=own.amplitudes)
    members = [Member(taken, point, _squares(point, records))]
    others = {p.effect.identity for p in point.placed}
    for rival in rivals:
        if rival.effect.identity in others:
            continue
        instead = tuple(rival.placed if p is own else p for p in point.placed)
        try:
            fitted, _ = refine(replace(point, placed=instead), records, within=FULLY)
            squares = _squares(fitted, records)
        except (ModelError, IdentificationError, np.linalg.LinAlgError):
            continue  # it fits nothing, so the records tell it apart
        at = _placed(fitted, rival.effect)
        assert at is not None
        tried = replace(rival, shape=at.shape, amplitudes=at.amplitudes)
        members.append(Member(tried, fitted, squares))
    return members


def not_told_apart(
    members: Sequence[Member], options: SearchOptions, left: float = 0.0
) -> list[Member]:
    """Return the simplest member that is not surely worse than the best, then its equals.

    Surely is by some standard errors of the sum of the differences over the blocks; a richer one
    must also be better by what any effect must take. One that is richer at the same place and not
    surely better is no equal: it can do what the simpler one does, as a dead zone that is wider
    than all commands, and nothing asks for more. `left`: the squared errors above noise that
    nothing explains; a difference of less than a hundredth of these tells nothing.
    """
    best = min(members, key=lambda m: float(m.squares.sum()))
    least = max(options.least_squares, options.accuracy * left)
    good = [m for m in members if not _worse(m.squares, best.squares, least, options)]
    chosen = min(good, key=lambda m: (numbers(m.tried.effect), m is not members[0]))
    same = max(_NOTHING, options.inexact * members[0].tried.gain, options.accuracy * left)
    equals = [
        m
        for m in members
        if not _worse(m.squares, chosen.squares, same, options) and not _contains(m, chosen)
    ]
    return [chosen, *(m for m in equals if m is not chosen)]


def supports(
    point: WorkingPoint, train: ColumnEvidence, options: SearchOptions
) -> dict[str, float]:
    """Return the share of resamples of the blocks that choose each effect, by identity.

    A resample chooses an effect if what the blocks lose without it, the others refitted, is no
    chance: noise of unit variance scatters a gain G by 2 sqrt(G), and blocks that gain without the
    effect show how much what is left scatters. That most blocks lose nothing tells nothing against
    an effect of which few of them could show anything.
    """
    if not point.placed:
        return {}
    rng = np.random.default_rng(0)
    found = {}
    for placed, cost in zip(point.placed, removal_costs(point, train), strict=True):
        some = cost[rng.integers(len(cost), size=(options.resamples, len(cost)))]
        apart = 2.0 * float(np.sum(np.minimum(cost, 0.0) ** 2))
        error = np.sqrt(2.0**2 * np.maximum(some.sum(axis=1), 0.0) + apart)
        found[placed.effect.identity] = float(
            np.mean(some.sum(axis=1) > options.standard_errors * error)
        )
    return found


def _squares(point: WorkingPoint, records: Records) -> Array:
    """Return the squared errors of the blocks (B,), with the noise that effects removed."""
    left = np.asarray(gather(point, records.train(point)).gram[:, -1, -1])
    return left + records.noise_removed(point)


def _worse(squares: Array, best: Array, nothing: float, options: SearchOptions) -> bool:
    difference = squares - best
    error = float(difference.std()) * np.sqrt(len(difference))
    return bool(difference.sum() > max(options.standard_errors * error, nothing))


def _shares(squares: Sequence[Array], resamples: int) -> tuple[float, ...]:
    """Return the share of resamples of the blocks in which each fit is best; equal ones share."""
    rng, blocks = np.random.default_rng(0), len(squares[0])
    picks = rng.integers(blocks, size=(resamples, blocks))
    sums = np.array([one[picks].sum(axis=1) for one in squares])
    first = sums < sums.min(axis=0) + _NOTHING
    return tuple((first / first.sum(axis=0)).mean(axis=1).tolist())


def _contains(member: Member, simpler: Member) -> bool:
    one, other = member.tried.effect, simpler.tried.effect
    return set(one.where) == set(other.where) and numbers(one) > numbers(other)


def _placed(point: WorkingPoint, effect: Effect) -> Placed | None:
    return next((p for p in point.placed if p.effect.identity == effect.identity), None)
