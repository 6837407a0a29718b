"""Add effects one by one (forward selection), each confirmed by held-out records."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from ....model.effects.base import Effect
from ....model.effects.friction import LAWS
from ..linearised.linearisation_point import MOST_TRUST, WorkingPoint
from ..search_options import SearchOptions
from .accepted_and_rejected_candidates import CandidateQueue
from .backward_elimination import (
    brought,
    taken_instead,
    without_guide,
    without_idle,
    without_stand_in,
)
from .candidate_screening import screened
from .friction_laws import best_laws
from .gauss_newton import Candidate, gather
from .nonrigid_screening import asked_first, worth_columns
from .predictive_criterion import HALF, Criterion, helps, is_worse, tested
from .prescreening import shortlisted
from .refine_with_candidate import refined_with
from .regression import ColumnEvidence
from .tested_candidate import FRICTION, HeldError, Records, Round, TimeOverError, Tried, is_internal

Progress = Callable[[str, float], None]

_CARRIERS = {"beam", "rotor"}
"""What comes between an effect and the platform is no place of the platform."""


class Grown(NamedTuple):
    """A working point with added effects, its held-out error, and the rounds."""

    point: WorkingPoint
    error: HeldError
    rounds: tuple[Round, ...]

    def much_left(self, options: SearchOptions) -> bool:
        """Return whether the held-out residual is large enough to search for more effects."""
        much = options.much_left**2 * self.error.floor
        return self.point.disturbance.measured and self.error.squares > much


def grown(
    begun: Grown,
    effects: Sequence[Effect],
    most: int,
    enough: float,
    records: Records,
    progress: Progress,
    options: SearchOptions,
) -> Grown:
    """Add effects while held-out records confirm them.

    It ends with `most` effects more, with held-out errors of `enough` times what noise leaves, or
    with its time, as far as it came.
    Every round ranks all candidates by regression, fits and tests those that explain most along the
    trajectories of the point, and fits the best of these with the whole model. It is taken if it
    passes the test again.
    """
    point, error, _ = begun
    rounds = list(begun.rounds)
    queue = CandidateQueue(point.placed)
    candidates = queue.candidates(effects)
    guides, most = 0, most + len(point.placed)
    with suppress(TimeOverError):
        while error.squares > enough * error.floor:
            near = error.squares < options.explained**2 * error.floor
            explained = point.disturbance.measured and near
            found, train, criterion = _screened(
                point, candidates, explained, rounds, records, queue.is_open, progress, options
            )
            taken = found.taken
            if taken is None or len(point.placed) >= most or queue.in_a_row >= options.patience:
                rounds.append(replace(found, taken=None, alternatives=()))
                break
            progress(f"adding {taken.effect.name}", options.share_done(len(rounds)))
            better, squares = refined_with(point, taken, train.squares, records)
            taken = _tested_again(point, taken.at(better.placed[-1]), records, options)
            better, squares, stood_in = without_stand_in(
                better, squares, taken, rounds, records, options
            )
            if stood_in is None and guides < options.patience:
                alone = without_guide(better, squares, train.excess, records, options)
                after = error if alone is None else records.held_error(alone)
                if alone is not None and is_worse(error, after, options):
                    # Nothing is accepted; candidates that led here may be tested again.
                    point, error, guides = alone, after, guides + 1
                    rounds.append(replace(found, taken=None))
                    continue
            found = replace(found, taken=taken)
            if taken.effect.key in LAWS and stood_in is None:
                found, better, squares = _of_best_law(
                    point, found, better, effects, records, options
                )
                taken = found.taken or taken
            better = records.with_estimated_noise(
                without_idle(_believing(better, squares, train), records, options)
            )
            after = records.held_error(better)
            stays = any(p.effect.identity == taken.effect.identity for p in better.placed)
            # What was foretold along the trajectories without it must come true.
            comes_true = criterion.takes(replace(taken, gain=train.squares - squares))
            if stays and comes_true and helps(taken, error, after, explained, criterion):
                point, error = better, after
                queue.take(taken, point.placed)
            else:
                found, stood_in = replace(found, taken=None), None
                queue.refuse(taken)
            if stood_in is None:
                rounds.append(found)
            else:  # it is as if it had been taken then
                rounds[stood_in] = taken_instead(rounds[stood_in], taken.effect.identity)
            candidates = queue.candidates(effects)
    return Grown(point, error, tuple(rounds))


def _of_best_law(
    before: WorkingPoint,
    found: Round,
    point: WorkingPoint,
    effects: Sequence[Effect],
    records: Records,
    options: SearchOptions,
) -> tuple[Round, WorkingPoint, float]:
    """Return round, point and squared errors with the best friction law instead of the accepted.

    `before` is the point without it.
    """
    assert found.taken is not None
    law, *others = best_laws(point, found.taken, effects, records, options)
    taken = _tested_again(before, law.tried.at(law.point.placed[-1]), records, options)
    found = replace(found, taken=taken, alternatives=tuple(m.tried for m in others))
    return found, law.point, float(law.squares.sum())


def _tested_again(
    point: WorkingPoint, tried: Tried, records: Records, options: SearchOptions
) -> Tried:
    """Repeat the test of a candidate whose shape was fitted since."""
    return tested(point, [tried], records, options)[0] if tried.shape else tried


def _screened(
    point: WorkingPoint,
    candidates: Sequence[Candidate],
    explained: bool,
    rounds: Sequence[Round],
    records: Records,
    is_open: Callable[[Tried], bool],
    progress: Progress,
    options: SearchOptions,
) -> tuple[Round, ColumnEvidence, Criterion]:
    """Screen the candidates; return the round, the residual of the training records, and the rule.

    Where those held out are explained only the drives are asked, unless the others are not.
    """
    internal = [c for c in candidates if is_internal(c[0])]
    asked = internal if explained else candidates
    first, rest = asked_first(point, asked)
    if first:
        progress(
            f"screening {len(first)} candidates in the non-rigid readings",
            options.share_done(len(rounds)),
        )
        little_of_it = HALF * options.least_free_gain * gather(point, records.train(point)).excess
        shown = records.shown(point, first)
        asked = [
            *rest,
            *worth_columns(first, shown, records.sensor_shape, little_of_it, options.shortlisted),
        ]
    progress(f"screening {len(asked)} candidates", options.share_done(len(rounds)))
    asked = shortlisted(point, asked, records, options)
    train = gather(point, records.train(point, asked))
    visible = options.visible * float(train.count.sum()) if explained else 0.0
    if explained and train.excess > visible:
        progress(f"screening {len(candidates)} candidates", options.share_done(len(rounds)))
        asked = shortlisted(point, candidates, records, options)
        train = gather(point, records.train(point, asked))
    before = rounds[0].excess - train.excess if rounds else 0.0
    criterion = Criterion(options, train.excess, before, visible, _rubbed(point, train))
    return screened(point, asked, train, records, criterion, is_open), train, criterion


def _rubbed(point: WorkingPoint, train: ColumnEvidence) -> dict[str, float]:
    """Return the squared errors that friction on each DOF explains."""
    if all(p.effect.effect_class != FRICTION for p in point.placed):
        return {}
    taken: dict[str, float] = {}
    for p, squares in zip(point.placed, brought(point, train), strict=True):
        if p.effect.effect_class == FRICTION:
            for where in set(p.effect.where) - _CARRIERS:
                taken[where] = max(taken.get(where, 0.0), squares)
    return taken


def _believing(point: WorkingPoint, squares: float, evidence: ColumnEvidence) -> WorkingPoint:
    """Return the point with trajectories as close to the model as the errors allow."""
    count = float(evidence.count.sum())
    wanted = float(np.clip(MOST_TRUST * (squares / count - 1.0), 1.0, MOST_TRUST))
    # In powers of four: filters are kept for each.
    return replace(point, trust=float(np.exp2(2.0 * np.ceil(0.5 * np.log2(wanted)))))
