"""Which effects are there: screened by regression, fitted together, kept if others agree."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ...model.effects.base import Effect
from ..data import IdentificationError
from .asked import Asked
from .giving_up import (
    followers,
    taken_instead,
    without_guesses,
    without_guide,
    without_idle,
    without_stand_in,
)
from .held_out import LOWERS, helps
from .plain import free_numbers, with_plain_amplitudes
from .refine import FULLY, NEARLY, Candidate, gather, refine
from .regression import Evidence, standard_errors
from .screening import (
    ALONE,
    BEYOND_CHANCE,
    LEAST,
    HeldError,
    Least,
    Records,
    Round,
    asked_again,
    is_internal,
    screened,
)
from .sifting import sifted, with_tried
from .working_point import WorkingPoint

Array = NDArray[np.float64]
Progress = Callable[[str, float], None]

_MOST_EFFECTS = 6
_MOST_UNKNOWN = 4
_TRUST = 1e3
_MOST_REFUSED = 3
_MOST_GUIDES = 2
"""Effects that led others out of their valleys: each costs a round, and may come again."""
_EXPLAINED = 1.06
"""Mean square errors of the free simulation, over what noise leaves, at which a model explains the
records: 1.03 times the floor. A force that only the drives feel does not show there."""
_UNSHOWN = 0.02
"""Share of what noise leaves of the records fitted to that may be beyond it where those held out
are explained: more is of an effect that these do not show."""
_MUCH = 1.7
"""Mean square errors of the free simulation, over what noise leaves, that free forms are tried on:
1.3 times the floor."""


@dataclass(frozen=True)
class Found:
    """The working point at the end, how it was reached, and what both sets of records leave.

    errors: standard errors of [the model's parameters over scale, amplitudes and shapes]; nan of
    what is held. idle: by identity, names that had followed what is random, and were dropped.
    """

    point: WorkingPoint
    rounds: tuple[Round, ...]
    errors: Array
    train: Evidence
    held: Evidence
    idle: frozenset[str] = frozenset()


def search(
    point: WorkingPoint,
    effects: Sequence[Effect],
    unknown: Sequence[Effect],
    records: Records,
    progress: Progress,
) -> Found:
    """Add effects one by one while records that were not used to choose them agree.

    `point` is at its best already. Every round tries all candidates by regression, fits the few
    that explain most, model and all, and takes the best of those. What is left in the end goes to
    free-form forces (`unknown`); a name whose place they can take was a guess, and is dropped.
    """
    error = records.held_error(point)
    if not np.isfinite(error.floor) or np.isnan(error.squares):
        raise IdentificationError(
            "expected a model that can be simulated freely over the records held out, since by "
            f"that effects are judged, found one that runs away (error {error.squares:.3g}, of "
            f"noise alone {error.floor:.3g}): an unstable plant has to be traced in its loop"
        )
    point, error, rounds = _grown(point, effects, _MOST_EFFECTS, 0.0, error, records, progress)
    if point.disturbance.measured and error.squares > _MUCH * error.floor:
        named = point
        point, error, more = _grown(point, unknown, _MOST_UNKNOWN, _MUCH, error, records, progress)
        rounds += more
        if point is not named:
            point = without_guesses(point, records)
            error = records.held_error(point)
    return _settled(point, error, rounds, records)


def without_followers(found: Found, records: Records) -> Found:
    """Return what was found without the names that may have followed a force that is random.

    Chance is that of errors that are white, and a force with no phase in a band is none: the best
    of a table takes something of it, and held-out records agree by chance of their own.
    """
    idle = followers(found.rounds)
    placed = tuple(p for p in found.point.placed if p.effect.identity not in idle)
    if len(placed) == len(found.point.placed):
        return found
    fewer = replace(found.point, placed=placed)
    settled = _settled(fewer, records.held_error(fewer), found.rounds, records)
    return replace(settled, idle=idle)


def _settled(
    point: WorkingPoint, error: HeldError, rounds: Sequence[Round], records: Records
) -> Found:
    """Return the point fitted to the end, with what it leaves."""
    # What was fitted last was so while it was not known whether more would come.
    fitted, _ = refine(point, records, within=FULLY)
    if records.held_error(fitted).squares < (1.0 + LOWERS) * error.squares:
        point = fitted
    plain = with_plain_amplitudes(point, records)
    if plain is not point and records.held_error(plain).squares < (1.0 + LOWERS) * error.squares:
        point = plain
    train, held = (gather(point, part) for part in (records.train(point), records.held(point)))
    free = free_numbers(point)
    errors = np.full(len(free), np.nan)
    errors[free] = standard_errors(train, np.flatnonzero(free))
    return Found(_with_errors(point, errors), tuple(rounds), errors, train, held)


def _grown(
    point: WorkingPoint,
    effects: Sequence[Effect],
    most: int,
    enough: float,
    error: HeldError,
    records: Records,
    progress: Progress,
) -> tuple[WorkingPoint, HeldError, list[Round]]:
    """Return the point with effects added while that helps, its held-out error, and the rounds.

    It ends with `most` effects, or with held-out errors of `enough` times what noise leaves.
    """
    rounds: list[Round] = []
    asked = Asked(point.placed)
    candidates = asked.candidates(effects)
    guides, most = 0, most + len(point.placed)
    while error.squares > enough * error.floor:
        explained = point.disturbance.measured and error.squares < _EXPLAINED * error.floor
        found, train = _screened(point, candidates, error, explained, rounds, records, progress)
        found = asked.worth(found)
        if not found.survivors or len(point.placed) >= most or asked.in_a_row >= _MOST_REFUSED:
            rounds.append(found)
            break
        progress(
            f"fitting {', '.join(t.effect.name for t in found.survivors)}", _share(len(rounds))
        )
        found = sifted(point, found, train, records)
        taken = found.taken
        assert taken is not None
        progress(f"adding {taken.effect.name}", _share(len(rounds)))
        better, squares = refine(with_tried(point, taken), records, within=NEARLY)
        taken = asked_again(point, taken, better.placed[-1], records)
        better, squares, stood_in = without_stand_in(better, squares, taken, rounds, records)
        if stood_in is None and guides < _MOST_GUIDES:
            alone = without_guide(better, squares, train.squares, records)
            after = error if alone is None else records.held_error(alone)
            if alone is not None and after.squares < (1.0 - LOWERS) * error.squares:
                # Nothing is taken; who has shown the way may be asked again.
                point, error, guides = alone, after, guides + 1
                rounds.append(replace(found, taken=None))
                continue
        found = replace(found, taken=taken)
        better = records.believed(without_idle(_believing(better, squares, train), records))
        after = records.held_error(better)
        gone = min((train.squares - squares) / max(train.excess, LEAST), 1.0)
        helped = helps(taken, error, after, gone, explained)
        agrees = taken.chance > (BEYOND_CHANCE if taken.held else ALONE)
        stays = any(p.effect.identity == taken.effect.identity for p in better.placed)
        if agrees and stays and squares < train.squares and helped:
            point, error = better, after
            asked.take(taken, point.placed)
        else:
            found, stood_in = replace(found, taken=None), None
            asked.refuse(taken)
        if stood_in is None:
            rounds.append(found)
        else:  # it is as if it had been taken then
            rounds[stood_in] = taken_instead(rounds[stood_in], taken.effect.identity)
        candidates = asked.candidates(effects)
    return point, error, rounds


def _screened(
    point: WorkingPoint,
    candidates: Sequence[Candidate],
    error: HeldError,
    explained: bool,
    rounds: Sequence[Round],
    records: Records,
    progress: Progress,
) -> tuple[Round, Evidence]:
    """Return a round in which nothing is taken yet, and what the records fitted to leave.

    Where those held out are explained only the drives are asked, but for what they do not show.
    """
    internal = [c for c in candidates if is_internal(c[0])]
    asked = internal if explained else candidates
    progress(f"screening {len(asked)} candidates", _share(len(rounds)))
    train = gather(point, records.train(point, asked))
    if explained and train.excess > _UNSHOWN * float(train.count.sum()):
        asked = candidates
        progress(f"screening {len(asked)} candidates", _share(len(rounds)))
        train = gather(point, records.train(point, asked))
    before = rounds[0].excess - train.excess if rounds else 0.0
    least = Least(train.excess, before, error.squares < _MUCH * error.floor, explained)
    return screened(point, asked, train, records, least), train


def _believing(point: WorkingPoint, squares: float, evidence: Evidence) -> WorkingPoint:
    """Return the point with its trajectories as close to the model as the errors allow."""
    count = float(evidence.count.sum())
    wanted = float(np.clip(_TRUST * (squares / count - 1.0), 1.0, _TRUST))
    # In decades: filters are kept for each.
    return replace(point, trust=float(10.0 ** np.ceil(np.log10(wanted))))


def _share(rounds: int) -> float:
    return 0.85 - 0.7 * 0.6**rounds


def _with_errors(point: WorkingPoint, errors: Array) -> WorkingPoint:
    """Return the point with the standard errors of its effects."""
    at, placed = len(point.parameters.names), []
    for p in point.placed:
        names = [q.name for q in (*p.effect.amplitudes, *p.effect.shape)]
        own = errors[at : at + len(names)]
        placed.append(replace(p, standard_errors=dict(zip(names, own.tolist(), strict=True))))
        at += len(names)
    return replace(point, placed=tuple(placed))
