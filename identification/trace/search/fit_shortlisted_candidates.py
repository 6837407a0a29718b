"""Fit the shortlisted candidates with the model; return the best and its equals."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ....model.effects.base import Placed
from ..linearised.linearisation_point import WorkingPoint
from .candidate_screening import Round, Tried
from .gauss_newton import ROUGHLY, Fitted, gather, refine
from .regression import ColumnEvidence

_ALIKE = 0.02
_NEAR = 12.0
"""Fits whose squared errors differ by less than this share of what they gain are not told apart,
nor those that differ by less than three standard deviations."""
_PRICE = 4.0
"""Squared errors that a parameter must save to be worth it."""
_TELLING = 0.8
_SIFTING_STEPS, _MOST_HEATS = 4, 4
"""Steps of a fit, after which it goes on if it is behind: once, and then as long as another such
fall makes it the best. A yielding spring has more numbers to find than a mass on a plain one."""
MOST_EQUALS = 6
"""Each is fitted in the place of the accepted effect when all are found."""
_UNFINISHED = 0.1
"""Share of what tells two fits apart that either may still lack."""


def sifted(
    point: WorkingPoint, found: Round, train: ColumnEvidence, records: Fitted
) -> tuple[Round, WorkingPoint]:
    """Fit the survivors of a round and accept the best; return the round and the working point.

    A candidate that fits at a shape of the grid may fit better in between, so the fits decide. They
    use the records that tell most of the survivors.
    """
    best_tried = found.survivors[0]
    if not any(tried.shape for tried in found.survivors):
        # What has no shape to move is where a fit would leave it already.
        alike = _plain_equals(found, best_tried)
        return replace(found, taken=best_tried, alternatives=alike), with_tried(point, best_tried)
    if len(found.survivors) == 1 and not found.elsewhere:
        alike = _plain_equals(found, best_tried)
        return replace(found, taken=best_tried, alternatives=alike), with_tried(point, best_tried)
    only = _telling(found.survivors, train)
    before = gather(point, records.train(point, only=only)).squares
    unfinished = _UNFINISHED * max(_ALIKE * best_tried.gain, _NEAR)

    def begin(tried: Tried) -> _Fit:
        told = np.isin(train.record, only)
        return _Fit(with_tried(point, tried), tried, before - float(tried.blocks[told].sum()))

    def fit(so_far: _Fit) -> _Fit:
        at, squares = refine(so_far.point, records, only, _SIFTING_STEPS, ROUGHLY, unfinished)
        last = at.placed[-1]
        squares += _PRICE * (len(last.amplitudes) + len(last.shape))
        tried = replace(so_far.tried, shape=last.shape, amplitudes=last.amplitudes)
        return _Fit(at, tried, squares, so_far.squares - squares)

    fitted = [fit(begin(tried)) for tried in found.survivors]
    for heat in range(1, _MOST_HEATS):
        best = min(one.squares for one in fitted)
        # How far the first falls says little: it begins at a guess.
        behind = [
            best < one.squares < best + (one.fell if heat > 1 or not one.tried.shape else np.inf)
            for one in fitted
        ]
        if not any(behind):
            break
        fitted = [fit(one) if on else one for one, on in zip(fitted, behind, strict=True)]
    fitted.sort(key=_squares)
    # A fit ends in the valley that it began in: the best one also begins elsewhere.
    identity = fitted[0].tried.effect.identity
    again = [fit(begin(t)) for t in found.elsewhere if t.effect.identity == identity]
    winner = min((fitted[0], *again), key=_squares)
    near = max(_ALIKE * (before - winner.squares), _NEAR)
    alike = tuple(one.tried for one in fitted[1:] if one.squares - winner.squares < near)
    alike = tuple(t for t in alike if t.shape and not told_apart(t, winner.tried))
    alike = (*alike, *_plain_equals(found, winner.tried))
    return replace(found, taken=winner.tried, alternatives=alike), winner.point


def _plain_equals(found: Round, best: Tried) -> tuple[Tried, ...]:
    """Return the best candidates of the ranking without shape that are not told from the best."""
    equals = [
        t
        for t in found.ranking
        if not t.shape
        and t.effect.identity != best.effect.identity
        and t.effect.effect_class != "unknown"
        and not told_apart(t, best)
    ]
    return tuple(equals[:MOST_EQUALS])


def told_apart(tried: Tried, best: Tried) -> bool:
    """Return whether all records reject a candidate without shape parameters.

    It gains there what a fit would. The records that tell most of the survivors need not be those
    that differ: two coils at one corner each turn the platform alike, until each pushes by itself.
    """
    return not tried.shape and best.gain - tried.gain >= max(_ALIKE * best.gain, _NEAR)


@dataclass(frozen=True)
class _Fit:
    """A partly fitted candidate, its squared errors, and their last decrease."""

    point: WorkingPoint
    tried: Tried
    squares: float
    fell: float = 0.0


def _squares(fit: _Fit) -> float:
    return fit.squares


def with_tried(point: WorkingPoint, tried: Tried) -> WorkingPoint:
    """Add a candidate with its tested parameters to the point."""
    return replace(
        point, placed=(*point.placed, Placed(tried.effect, tried.shape, tried.amplitudes))
    )


def _telling(survivors: Sequence[Tried], train: ColumnEvidence) -> list[int]:
    """Return the numbers of the records with most of the survivors' gain."""
    gain = np.zeros(int(train.record.max()) + 1)
    for tried in survivors:
        share = np.bincount(train.record, np.maximum(tried.blocks, 0.0), len(gain))
        gain += share / max(share.sum(), 1e-300)
    order = np.argsort(-gain)
    enough = np.searchsorted(np.cumsum(gain[order]), _TELLING * gain.sum()) + 1
    return sorted(order[: max(enough, 2)].tolist())
