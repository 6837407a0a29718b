"""The few that explain most, fitted with the model: the best of them, and which fit as well."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ...model.effects.base import Placed
from .refine import ROUGHLY, Fitted, gather, refine
from .regression import Evidence
from .screening import Round, Tried
from .working_point import WorkingPoint

_ALIKE = 0.02
_NEAR = 12.0
"""Fits whose squared errors differ by less than this share of what they gain are not told apart,
nor those that differ by less than three standard deviations."""
_PRICE = 4.0
"""Squared errors that a parameter must save to be worth it."""
_TELLING = 0.8
_SIFTING_STEPS = 4
_UNFINISHED = 0.1
"""Share of what tells two fits apart that either may still lack."""


def sifted(point: WorkingPoint, found: Round, train: Evidence, records: Fitted) -> Round:
    """Return the round with its survivors fitted, and the best of them taken.

    A candidate that fits at a shape of the grid may fit better in between, so the fits decide. They
    use the records that tell most of the survivors.
    """
    best_tried = found.survivors[0]
    if not any(tried.shape for tried in found.survivors):
        # What has no shape to move is where a fit would leave it already.
        near = max(_ALIKE * best_tried.gain, _NEAR)
        alike = tuple(t for t in found.survivors[1:] if best_tried.gain - t.gain < near)
        return replace(found, taken=best_tried, alternatives=alike)
    if len(found.survivors) == 1 and not found.elsewhere:
        return replace(found, taken=best_tried)
    only = _telling(found.survivors, train)
    before = gather(point, records.train(point, only=only)).squares
    unfinished = _UNFINISHED * max(_ALIKE * best_tried.gain, _NEAR)

    def fit(tried: Tried) -> tuple[float, Tried]:
        at, squares = refine(
            with_tried(point, tried),
            records,
            only,
            _SIFTING_STEPS,
            ROUGHLY,
            unfinished,
        )
        last = at.placed[-1]
        price = _PRICE * (len(last.amplitudes) + len(last.shape))
        return squares + price, replace(tried, shape=last.shape, amplitudes=last.amplitudes)

    fitted = sorted((fit(tried) for tried in found.survivors), key=lambda pair: pair[0])
    # A fit ends in the valley that it began in: the best one also begins elsewhere.
    identity = fitted[0][1].effect.identity
    again = [fit(t) for t in found.elsewhere if t.effect.identity == identity]
    fitted[0] = min(fitted[0], *again, key=lambda pair: pair[0]) if again else fitted[0]
    best, taken = fitted[0]
    near = max(_ALIKE * (before - best), _NEAR)
    alike = tuple(tried for squares, tried in fitted[1:] if squares - best < near)
    return replace(found, taken=taken, alternatives=alike)


def with_tried(point: WorkingPoint, tried: Tried) -> WorkingPoint:
    """Return the point with a candidate added as it was tried."""
    return replace(
        point, placed=(*point.placed, Placed(tried.effect, tried.shape, tried.amplitudes))
    )


def _telling(survivors: Sequence[Tried], train: Evidence) -> list[int]:
    """Return the numbers of the records in which the survivors gain most, most of it in all."""
    gain = np.zeros(int(train.record.max()) + 1)
    for tried in survivors:
        share = np.bincount(train.record, np.maximum(tried.blocks, 0.0), len(gain))
        gain += share / max(share.sum(), 1e-300)
    order = np.argsort(-gain)
    enough = np.searchsorted(np.cumsum(gain[order]), _TELLING * gain.sum()) + 1
    return sorted(order[: max(enough, 2)].tolist())
