"""Shortlist the candidates by the records that have most to explain, before all records are asked.

What a candidate does in a record costs as much as the record is long. In the records with the
largest errors for their length, those that explain most of all records are among the best already;
which of them is best, all records tell.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ..linearised.linearisation_point import WorkingPoint
from ..search_options import SearchOptions
from .gauss_newton import Candidate, Fitted, gather
from .regression import FOLDS, ColumnEvidence, gains
from .tested_candidate import is_internal

Array = NDArray[np.float64]

_PART = 1.0 / 3.0
"""Of the time of all records, as much is asked first."""
_SHAPE = 0.5
"""Shapes that explain less than this share of what the best one of an effect does are left out."""


def shortlisted(
    point: WorkingPoint,
    candidates: Sequence[Candidate],
    records: Fitted,
    options: SearchOptions,
) -> list[Candidate]:
    """Return the candidates that explain most of some records, in their order.

    All are returned if they are few, or if some records have too few blocks. What acts on the
    drives only is among them: what these measure is no error of the platform, by which the records
    are chosen.
    """
    if len({e.identity for e, _ in candidates}) <= options.shortlisted:
        return list(candidates)
    chosen = [c for c in candidates if not is_internal(c[0])]
    best = {id(c) for c in _best(point, chosen, records, options.shortlisted)}
    return [c for c in candidates if is_internal(c[0]) or id(c) in best]


def _best(
    point: WorkingPoint, candidates: Sequence[Candidate], records: Fitted, count: int
) -> list[Candidate]:
    train = gather(point, records.train(point))
    only = most_telling(train, train.gram[:, -1, -1] - train.count)
    if not only:
        return list(candidates)
    some = gather(point, records.train(point, candidates, only))
    gained = [float(gain.sum()) for gain in gains(some)]
    finite = [i for i in range(len(candidates)) if np.isfinite(gained[i])]
    finite.sort(key=lambda i: -gained[i])
    most: dict[str, float] = {}
    for i in finite:
        most.setdefault(candidates[i][0].identity, gained[i])
    best = dict(list(most.items())[:count])
    return [
        c
        for c, gain in zip(candidates, gained, strict=True)
        if c[0].identity in best and gain >= _SHAPE * best[c[0].identity]
    ]


def most_telling(train: ColumnEvidence, squares: Array) -> list[int]:
    """Return the numbers of the records with most squared errors (B,) of blocks for their length.

    They are a third of the time; none if these are too few to tell.
    """
    count = np.bincount(train.record, train.count)
    total = np.bincount(train.record, squares)
    order = np.argsort(-total / np.maximum(count, 1.0))
    enough = int(np.searchsorted(np.cumsum(count[order]), _PART * count.sum())) + 1
    chosen = sorted(order[:enough].tolist())
    blocks = int(np.isin(train.record, chosen).sum())
    return chosen if len(chosen) < len(count) and blocks >= 2 * FOLDS else []
