"""Fix amplitudes at one if the effect fits nearly as well, as in the textbook form."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ....model.effects.base import Placed
from ..linearised.linearisation_point import WorkingPoint
from ..search_options import SearchOptions
from .gauss_newton import FULLY, Fitted, gather, refine


def with_plain_amplitudes(
    point: WorkingPoint, records: Fitted, options: SearchOptions
) -> WorkingPoint:
    """Fix unnecessary amplitudes at one and refit; return the point.

    Regression asks of everything how much of it there is. Of a saturation there is all: how deep it
    is, and from where on, are one number far below its limit, and along that valley neither is
    known.
    """
    squares = None
    for i, placed in enumerate(point.placed):
        if placed.effect.shape_of_unit_amplitude is None:
            continue
        if squares is None:
            squares = gather(point, records.train(point)).squares
        held = (*point.placed[:i], _held(placed), *point.placed[i + 1 :])
        fitted, left = refine(replace(point, placed=held), records, within=FULLY)
        if left - squares < options.least_squares:
            point, squares = fitted, left
    return point


def free_numbers(point: WorkingPoint) -> NDArray[np.bool_]:
    """Return which of [parameters, amplitudes, shapes] (P,) are free."""
    held = [q.low == q.high for p in point.placed for q in (*p.effect.amplitudes, *p.effect.shape)]
    return ~np.array([False] * len(point.parameters.names) + held, dtype=bool)


def _held(placed: Placed) -> Placed:
    effect, plain = placed.effect, placed.effect.shape_of_unit_amplitude
    assert plain is not None
    amplitudes = tuple(replace(q, low=1.0, high=1.0) for q in effect.amplitudes)
    shape = [
        float(np.clip(value, q.low, q.high))
        for value, q in zip(plain(placed.amplitudes, placed.shape), effect.shape, strict=True)
    ]
    return Placed(
        replace(effect, amplitudes=amplitudes), tuple(shape), tuple(1.0 for _ in amplitudes)
    )
