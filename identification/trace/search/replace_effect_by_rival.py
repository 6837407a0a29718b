"""Escape local minima: replace an accepted effect by a close rival and search on."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ....model.declared_model import ModelError
from ....model.effects.base import Effect
from ...records.record import IdentificationError
from ..linearised.linearisation_point import WorkingPoint
from ..search_options import SearchOptions
from .forward_selection import Grown, Progress, grown
from .gauss_newton import NEARLY, refine
from .predictive_criterion import confirmed, tested
from .tested_candidate import Records, Round, TimeOverError, Tried

_HALF = 0.5
"""Of what was taken gained, as much as a rival has to gain to be tried in its place; and of what is
left, as much as may stay of it where another way is right."""


def otherwise(
    found: Grown,
    effects: Sequence[Effect],
    most: int,
    records: Records,
    progress: Progress,
    options: SearchOptions,
) -> Grown:
    """Return a better result with one accepted effect replaced by a rival, else the given one.

    Effects are taken one by one, and what looks most like two of them together bars the way to
    both: of drag that grows with the square of the speed and dry friction it is a linear damper.
    Or what is right has a longer way to its best shape than it was given beside the others.
    So where much is left, those that explained half as much are put in the place of what was taken,
    last ones first, and the search goes on from there, to at most `most` effects more. A way counts
    if it leaves half of what is left, and of those the one that leaves least.
    """
    ways = [
        (number, rival)
        for number, one in reversed(list(enumerate(found.rounds)))
        if one.taken is not None
        for rival in _rivals(one, found.point)
    ]
    best, least = found, _HALF * (found.error.squares - found.error.floor)
    for number, rival in ways[: options.patience]:
        at = options.share_done(len(found.rounds))
        progress(f"trying {rival.effect.name} instead", at)
        try:
            begun = _instead(found, number, rival, records, options)
            if begun is None:
                continue
            there = _staying(progress, at)
            way = grown(begun, effects, most, 0.0, records, there, options)
        except TimeOverError:
            break
        except (ModelError, IdentificationError, np.linalg.LinAlgError):
            continue  # it leads nowhere, and what was found stays
        left = way.error.squares - way.error.floor
        if left < least:
            best, least = way, left
        if not best.much_left(options):
            break
    return best


def _instead(
    found: Grown, number: int, rival: Tried, records: Records, options: SearchOptions
) -> Grown | None:
    """Replace the accepted effect of a round by a rival.

    None where that runs away, or held-out records do not agree with the rival as it then fits.
    Raises ModelError, IdentificationError, LinAlgError: it does not fit at all.
    """
    earlier = found.rounds[number]
    assert earlier.taken is not None
    given_up = earlier.taken.effect.identity
    others = tuple(p for p in found.point.placed if p.effect.identity != given_up)
    without = replace(found.point, placed=others)
    begun = replace(without, placed=(*others, rival.placed))
    point, _ = refine(begun, records, within=NEARLY)
    rival = tested(without, [rival.at(point.placed[-1])], records, options)[0]
    error = records.held_error(point)
    if not np.isfinite(error.squares) or not confirmed(rival.agreement, options):
        return None
    taken = replace(earlier, taken=rival, alternatives=(), instead_of=earlier.taken.effect)
    rounds = [taken if r is earlier else r for r in found.rounds if r.taken is not None]
    return Grown(point, error, tuple(rounds))


def _rivals(found: Round, point: WorkingPoint) -> list[Tried]:
    """Return the close rivals of an accepted effect that is still in the model."""
    taken = found.taken
    there = {p.effect.identity for p in point.placed}
    if taken is None or taken.effect.identity not in there:
        return []
    return [
        t for t in found.survivors if t.effect.identity not in there and t.gain > _HALF * taken.gain
    ]


def _staying(progress: Progress, at: float) -> Progress:
    """Return the same in words, and no less far than it was: a way begins where others ended."""
    return lambda step, done: progress(step, max(done, at))
