"""Fit the shortlisted candidates with the model; return the best and its equals."""

from __future__ import annotations

from dataclasses import replace

from ....model.effects.base import Placed
from ..linearised.linearisation_point import WorkingPoint
from .candidate_screening import Round, Tried
from .gauss_newton import Fitted
from .separable_least_squares import with_fitted_shapes

_ALIKE = 0.02
_NEAR = 12.0
"""Fits whose squared errors differ by less than this share of what they gain are not told apart,
nor those that differ by less than three standard deviations."""
_ALONG = 0.05
"""The same share for shapes that were fitted along the trajectories of the point. What they gain
differs by up to 2 % from what a fit of the whole model gains."""
_PRICE = 4.0
"""Squared errors that a parameter must save to be worth it."""
MOST_EQUALS = 6
"""Each is fitted in the place of the accepted effect when all are found."""


def sifted(point: WorkingPoint, found: Round, records: Fitted) -> tuple[Round, WorkingPoint]:
    """Fit the shapes of a round's survivors, and accept the best; return round and working point.

    A candidate that explains most at a shape of the grid need not do so in between. Those that gain
    nearly as much are its alternatives.
    """
    best_tried = found.survivors[0]
    if not any(tried.shape for tried in found.survivors):
        alike = _plain_equals(found, best_tried)
        return replace(found, taken=best_tried, alternatives=alike), with_tried(point, best_tried)
    begun = [*found.survivors, *found.elsewhere]
    fitted: dict[str, Tried] = {}
    for tried in sorted(with_fitted_shapes(point, begun, records), key=_worth, reverse=True):
        fitted.setdefault(tried.effect.identity, tried)
    winner, *others = fitted.values()
    near = max(_ALONG * winner.gain, _NEAR)
    alike = tuple(t for t in others if t.shape and _worth(winner) - _worth(t) < near)
    alike = (*alike, *_plain_equals(found, winner))
    return replace(found, taken=winner, alternatives=alike), with_tried(point, winner)


def _worth(tried: Tried) -> float:
    """Return what a candidate gains beyond the price of its numbers."""
    return tried.gain - _PRICE * (len(tried.amplitudes) + len(tried.shape))


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
    """Return whether a candidate gains so much less than another one that it need not be fitted."""
    return best.gain - tried.gain >= max(_ALIKE * best.gain, _NEAR)


def with_tried(point: WorkingPoint, tried: Tried) -> WorkingPoint:
    """Add a candidate with its tested parameters to the point."""
    return replace(
        point, placed=(*point.placed, Placed(tried.effect, tried.shape, tried.amplitudes))
    )
