"""Refine a working point with a candidate added, from where the linearised records ask it to be.

Their errors are linear in the numbers of the model and in the amplitudes of the candidate. A fit
that begins where they are smallest, rather than with the candidate beside numbers that were fitted
without it, is at its end mostly; a point that is not asked saves as much as all candidates cost.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ....model.declared_model import ModelError
from ...records.record import IdentificationError
from ..linearised.linearisation_point import WorkingPoint
from .backward_elimination import without_effect
from .gauss_newton import NEARLY, Fitted, gather, least_squares_step, refine, stepped
from .tested_candidate import Tried


def refined_with(
    point: WorkingPoint, taken: Tried, squares: float, records: Fitted
) -> tuple[WorkingPoint, float]:
    """Return the point with a candidate added, refined, and its squared errors.

    `squares` are those without it. If the numbers that the linearised records ask for cannot be
    computed with, or are no better, all but the candidate begin where they are.
    """
    try:
        moved = moved_beside(point, taken, records)
        better, left = refine(_with(moved, taken), records, within=NEARLY)
        if left < squares:
            return better, left
    except (ModelError, IdentificationError, np.linalg.LinAlgError):
        pass
    return refine(_with(point, taken), records, within=NEARLY)


def moved_beside(point: WorkingPoint, taken: Tried, records: Fitted) -> WorkingPoint:
    """Return the point with its numbers where the linearised records ask them to be beside a
    candidate, which has its amplitudes and its shape."""
    train = gather(point, records.train(point, [(taken.effect, taken.shape)]))
    own = len(train.size) - 1
    columns = range(own, own + len(taken.amplitudes))
    beside = without_effect(train.joined(0), columns, [-a for a in taken.amplitudes])
    return stepped(point, least_squares_step(point, beside))


def _with(point: WorkingPoint, taken: Tried) -> WorkingPoint:
    return replace(point, placed=(*point.placed, taken.placed))
