"""Effects as books have them: amplitudes of one, where that fits about as well."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ...model.effects.base import Placed
from .refine import FULLY, Fitted, refine
from .screening import LEAST
from .working_point import WorkingPoint


def with_plain_amplitudes(
    point: WorkingPoint, squares: float, records: Fitted
) -> tuple[WorkingPoint, float]:
    """Return the point, and its squared errors, with what need not have an amplitude held at one.

    Regression asks of everything how much of it there is. Of a saturation there is all: how deep it
    is, and from where on, are one number far below its limit, and along that valley neither is
    known.
    """
    for i, placed in enumerate(point.placed):
        if placed.effect.plain is None:
            continue
        others = point.placed[:i], point.placed[i + 1 :]
        held = replace(point, placed=(*others[0], _held(placed), *others[1]))
        fitted, left = refine(held, records, within=FULLY)
        if left - squares < LEAST:
            point, squares = fitted, left
    return point, squares


def is_held(placed: Placed) -> list[bool]:
    """Return which of its amplitudes and shape can only be what they are."""
    return [q.low == q.high for q in (*placed.effect.amplitudes, *placed.effect.shape)]


def _held(placed: Placed) -> Placed:
    effect, plain = placed.effect, placed.effect.plain
    assert plain is not None
    amplitudes = tuple(replace(q, low=1.0, high=1.0) for q in effect.amplitudes)
    shape = [
        float(np.clip(value, q.low, q.high))
        for value, q in zip(plain(placed.amplitudes, placed.shape), effect.shape, strict=True)
    ]
    return Placed(
        replace(effect, amplitudes=amplitudes), tuple(shape), tuple(1.0 for _ in amplitudes)
    )
