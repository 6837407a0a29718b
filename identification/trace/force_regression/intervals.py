"""Compute standard errors of all numbers of a model: from blocks of time, band and noise."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ...subspace.response_uncertainty import SURE_95
from .candidate_fit import flat
from .force_record import ForceModel
from .training_records import Training

Array = NDArray[np.float64]


def standard_errors(point: ForceModel, training: Training, others: Sequence[Training]) -> Array:
    """Return the standard error of each free number of a fitted model (F + effects').

    The numbers are parameters, then amplitudes and shapes of each effect. Errors come from the
    scatter of blocks (what a model lacks is coloured, and correlates with its columns), and from
    the largest change by a fit to `others`: in another band, or with more noise in the motion.
    """
    at = training.at(point)
    groups = training.group_columns(at)
    columns = training.columns(at, groups)
    size = np.linalg.norm(flat(columns), axis=0)
    size = np.where(size > 0.0, size, 1.0)
    grams = training.judged(at, columns, groups)
    scale = np.append(size, 1.0)
    blocks = grams.grams.sum(axis=1) / scale[:, None] / scale
    prior = grams.prior / scale[:, None] / scale
    inner = blocks.sum(axis=0)[:-1, :-1] + prior[:-1, :-1]
    scores = blocks[:, :-1, -1]
    scores = scores - scores.mean(axis=0)
    count = len(scores)
    inverse = np.linalg.pinv(inner, rcond=1e-10, hermitian=True)
    middle = scores.T @ scores * (count / max(count - 1, 1)) + prior[:-1, :-1]
    se = np.sqrt(np.maximum(np.diag(inverse @ middle @ inverse), 0.0)) / size
    unit = np.concatenate([point.parameters.scale, np.ones(len(se) - len(point.values))])
    se = se * unit
    moved = [np.abs(numbers(other.fit(point)) - numbers(point)) for other in others]
    spread = np.max(moved, axis=0) if moved else np.zeros(len(se))
    return np.asarray(np.hypot(se, spread / SURE_95))


def numbers(point: ForceModel) -> Array:
    """Return all numbers of a model (F + effects'): parameters, then amplitudes and shapes."""
    placed = [v for p in point.placed for v in (*p.amplitudes, *p.shape)]
    return np.concatenate([point.values, np.array(placed)])
