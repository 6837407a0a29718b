"""Shortlist the candidates by parts of records that have most to explain, before all are asked.

What a candidate does in a record costs as much as the record is long. In the parts with the largest
errors, those that explain most of all records are among the best already; which of them is best,
all records tell. Parts are as short as tell an effect that matters from chance. Of what depends on
the session's time, as a load that is put on once, no part tells: whole records are asked.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ...rounding import TINY
from ..linearised.linearisation_point import WorkingPoint
from ..search_options import SearchOptions
from .gauss_newton import Candidate, Fitted, Part, gather
from .regression import FOLDS, ColumnEvidence, gains
from .tested_candidate import is_internal

Array = NDArray[np.float64]

_PART = 1.0 / SearchOptions.resolved
"""Of the time of all records, as much is asked first at most."""
_SHAPE = 0.5
"""Shapes that explain less than this share of what the best one of an effect does are left out."""


def shortlisted(
    point: WorkingPoint,
    candidates: Sequence[Candidate],
    records: Fitted,
    options: SearchOptions,
) -> list[Candidate]:
    """Return the candidates that explain most of some records, in their order.

    All are returned if they are few, and those for which a part of the records has too few blocks.
    What acts on the drives only is among them: what these measure is no error of the platform, by
    which parts are chosen.
    """
    if len({e.identity for e, _ in candidates}) <= options.shortlisted:
        return list(candidates)
    train = gather(point, records.train(point))
    left = train.gram[:, -1, -1] - train.count
    # What matters takes a share of these that is no chance.
    parts = most_telling(train, left[None], options.least_squares / options.least_gain)
    whole = most_telling_records(train, left)
    shares: dict[int, float] = {}
    for only, timed in ((parts, False), (whole, True)):
        asked = [c for c in candidates if not is_internal(c[0]) and c[0].of_session_time == timed]
        if only and asked:
            some = gather(point, records.train(point, asked, only))
            for one, gain in zip(asked, gains(some), strict=True):
                shares[id(one)] = float(gain.sum()) / max(some.excess, 1.0)
    best = _best([c for c in candidates if id(c) in shares], shares, options.shortlisted)
    return [c for c in candidates if id(c) not in shares or id(c) in best]


def _best(candidates: Sequence[Candidate], shares: dict[int, float], count: int) -> set[int]:
    """Return those of the effects that explain the largest shares of what they were asked about."""
    finite = [c for c in candidates if np.isfinite(shares[id(c)])]
    most: dict[str, float] = {}
    for one in sorted(finite, key=lambda c: -shares[id(c)]):
        most.setdefault(one[0].identity, shares[id(one)])
    best = dict(list(most.items())[:count])
    return {id(c) for c in finite if shares[id(c)] >= _SHAPE * best.get(c[0].identity, np.inf)}


def most_telling(train: ColumnEvidence, squares: Array, needed: float) -> list[Part]:
    """Return the part of every record with most of some squared errors (k, blocks).

    Every record has part, as each tells of another pose. The parts are as short as hold `needed` of
    each of the k together, and can be cross-validated. None are returned where a part of the time
    has too few blocks for that.
    """
    sums = np.maximum(np.abs(squares).sum(axis=1), TINY)
    worth = (squares / sums[:, None]).sum(axis=0)
    blocks = np.bincount(train.record)
    parts: list[Part] = []
    for length in range(1, int(blocks.max()) + 1):
        longer = [
            _best_part(number, worth[train.record == number], length)
            for number in range(len(blocks))
        ]
        inside = np.concatenate([_is_in(p, n) for p, n in zip(longer, blocks, strict=True)])
        if train.count[inside].sum() > _PART * train.count.sum():
            break
        parts = longer
        if inside.sum() >= 2 * FOLDS and np.all(squares[:, inside].sum(axis=1) >= needed):
            return parts
    return parts if sum(p.last - p.first for p in parts) >= 2 * FOLDS else []


def most_telling_records(train: ColumnEvidence, squares: Array) -> list[Part]:
    """Return the records with most squared errors (blocks,) for their length, as parts.

    They are a quarter of the time; none if these have too few blocks to tell, or are all.
    """
    blocks = np.bincount(train.record)
    count = np.bincount(train.record, train.count)
    total = np.bincount(train.record, squares)
    order = np.argsort(-total / np.maximum(count, 1.0))
    enough = int(np.searchsorted(np.cumsum(count[order]), _PART * count.sum())) + 1
    chosen = sorted(order[:enough].tolist())
    if len(chosen) == len(blocks) or blocks[chosen].sum() < 2 * FOLDS:
        return []
    return [Part(number, 0, int(blocks[number])) for number in chosen]


def _best_part(number: int, worth: Array, length: int) -> Part:
    """Return the blocks of a record, as many as `length` or all, that are worth most together."""
    length = min(length, len(worth))
    total = np.append(0.0, np.cumsum(worth))
    first = int(np.argmax(total[length:] - total[: len(total) - length]))
    return Part(number, first, first + length)


def _is_in(part: Part, blocks: int) -> NDArray[np.bool_]:
    """Return which blocks of its record (blocks,) are in a part."""
    number = np.arange(blocks)
    return (number >= part.first) & (number < part.last)
