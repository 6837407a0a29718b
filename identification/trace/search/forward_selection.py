"""Add effects one by one (forward selection), each confirmed by held-out records."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from ....model.effects.base import Effect
from ....model.effects.friction import LAWS
from ..linearised.linearisation_point import WorkingPoint
from .accepted_and_rejected_candidates import CandidateQueue
from .backward_elimination import (
    brought,
    taken_instead,
    without_guide,
    without_idle,
    without_stand_in,
)
from .candidate_screening import (
    ALONE,
    AT_FIRST,
    BEYOND_CHANCE,
    DESCRIBES,
    FRICTION,
    LEAST,
    HeldError,
    Least,
    Records,
    Round,
    Tried,
    asked_again,
    is_internal,
    screened,
)
from .fit_shortlisted_candidates import sifted
from .friction_laws import best_laws
from .gauss_newton import NEARLY, Candidate, gather, refine
from .held_out_test import LOWERS, helps
from .nonrigid_screening import asked_first, worth_columns
from .prescreening import shortlisted
from .regression import ColumnEvidence

Progress = Callable[[str, float], None]

MUCH = 1.7
"""Mean square errors of the free simulation, over what noise leaves, beyond which much is left that
no name explains: 1.3 times the floor."""
_TRUST = 1e3
_MOST_REFUSED = 3
_MOST_GUIDES = 2
"""Effects that led others out of their valleys: each costs a round, and may come again."""
_EXPLAINED = 1.06
"""Mean square errors of the free simulation, over what noise leaves, at which a model explains the
records: 1.03 times the floor. A force that only the drives feel does not show there."""
_VISIBLE = 0.02
"""Share of what noise leaves of the records fitted to that may be beyond it where the simulation of
those held out is explained: more is of an effect that they do not show, or only one step ahead."""
_CARRIERS = {"beam", "rotor"}
"""What comes between an effect and the platform is no place of the platform."""


class Grown(NamedTuple):
    """A working point with added effects, its held-out error, and the rounds."""

    point: WorkingPoint
    error: HeldError
    rounds: tuple[Round, ...]

    @property
    def much_left(self) -> bool:
        """Whether the held-out residual is large enough to search for more effects."""
        return self.point.disturbance.measured and self.error.squares > MUCH * self.error.floor


def grown(
    begun: Grown,
    effects: Sequence[Effect],
    most: int,
    enough: float,
    records: Records,
    progress: Progress,
) -> Grown:
    """Add effects while held-out records confirm them.

    It ends with `most` effects more, or with held-out errors of `enough` times what noise leaves.
    Every round tries all candidates by regression, fits the few that explain most, model and all,
    and takes the best of those.
    """
    point, error, _ = begun
    rounds = list(begun.rounds)
    queue = CandidateQueue(point.placed)
    candidates = queue.candidates(effects)
    guides, most = 0, most + len(point.placed)
    while error.squares > enough * error.floor:
        explained = point.disturbance.measured and error.squares < _EXPLAINED * error.floor
        found, train = _screened(point, candidates, error, explained, rounds, records, progress)
        found = queue.worth(found)
        if not found.survivors or len(point.placed) >= most or queue.in_a_row >= _MOST_REFUSED:
            rounds.append(found)
            break
        progress(f"fitting {', '.join(t.effect.name for t in found.survivors)}", share(len(rounds)))
        found, begun_at = sifted(point, found, records)
        taken = found.taken
        assert taken is not None
        progress(f"adding {taken.effect.name}", share(len(rounds)))
        better, squares = refine(begun_at, records, within=NEARLY)
        taken = asked_again(point, taken, better.placed[-1], records)
        better, squares, stood_in = without_stand_in(better, squares, taken, rounds, records)
        if stood_in is None and guides < _MOST_GUIDES:
            alone = without_guide(better, squares, train.squares, records)
            after = error if alone is None else records.held_error(alone)
            if alone is not None and after.squares < (1.0 - LOWERS) * error.squares:
                # Nothing is accepted; candidates that led here may be tested again.
                point, error, guides = alone, after, guides + 1
                rounds.append(replace(found, taken=None))
                continue
        found = replace(found, taken=taken)
        if taken.effect.key in LAWS and stood_in is None:
            found, better, squares = _of_best_law(point, found, better, effects, records)
            taken = found.taken or taken
        better = records.with_estimated_noise(
            without_idle(_believing(better, squares, train), records)
        )
        after = records.held_error(better)
        gone = min((train.squares - squares) / max(train.excess, LEAST), 1.0)
        enough_of_it = taken.effect.effect_class != "unknown" or gone > DESCRIBES
        helped = enough_of_it and helps(taken, error, after, gone, explained)
        stays = any(p.effect.identity == taken.effect.identity for p in better.placed)
        if agree(taken) and stays and squares < train.squares and helped:
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
) -> tuple[Round, WorkingPoint, float]:
    """Return round, point and squared errors with the best friction law instead of the accepted.

    `before` is the point without it.
    """
    assert found.taken is not None
    law, *others = best_laws(point, found.taken, effects, records)
    taken = asked_again(before, law.tried, law.point.placed[-1], records)
    found = replace(found, taken=taken, alternatives=tuple(m.tried for m in others))
    return found, law.point, float(law.squares.sum())


def agree(tried: Tried) -> bool:
    """Return whether held-out records confirm a fitted candidate."""
    return tried.chance > (BEYOND_CHANCE if tried.held else ALONE)


def share(rounds: int) -> float:
    """Return the progress of a search after a number of rounds (0 to 1)."""
    return 0.85 - 0.7 * 0.6**rounds


def _screened(
    point: WorkingPoint,
    candidates: Sequence[Candidate],
    error: HeldError,
    explained: bool,
    rounds: Sequence[Round],
    records: Records,
    progress: Progress,
) -> tuple[Round, ColumnEvidence]:
    """Screen the candidates; return the round, and the residual of the training records.

    Where those held out are explained only the drives are asked, unless the others are not.
    """
    internal = [c for c in candidates if is_internal(c[0])]
    asked = internal if explained else candidates
    first, rest = asked_first(point, asked)
    if first:
        progress(f"screening {len(first)} candidates in the non-rigid readings", share(len(rounds)))
        little_of_it = AT_FIRST * DESCRIBES * gather(point, records.train(point)).excess
        shown = records.shown(point, first)
        asked = [*rest, *worth_columns(first, shown, records.sensor_shape, little_of_it)]
    progress(f"screening {len(asked)} candidates", share(len(rounds)))
    asked = shortlisted(point, asked, records)
    train = gather(point, records.train(point, asked))
    visible = _VISIBLE * float(train.count.sum()) if explained else 0.0
    if explained and train.excess > visible:
        progress(f"screening {len(candidates)} candidates", share(len(rounds)))
        asked = shortlisted(point, candidates, records)
        train = gather(point, records.train(point, asked))
    before = rounds[0].excess - train.excess if rounds else 0.0
    little = error.squares < MUCH * error.floor
    least = Least(train.excess, before, little, visible, _rubbed(point, train))
    return screened(point, asked, train, records, least), train


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
    wanted = float(np.clip(_TRUST * (squares / count - 1.0), 1.0, _TRUST))
    # In decades: filters are kept for each.
    return replace(point, trust=float(10.0 ** np.ceil(np.log10(wanted))))
