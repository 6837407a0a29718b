"""Which effects are there: screened by regression, fitted together, kept if others agree."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from ...model.effects.base import Effect, Placed
from .grams import Linearised
from .refine import Candidate, Fitted, gather, refine
from .regression import (
    Evidence,
    chance,
    chance_between,
    covariance,
    cross_validated,
    expected,
    gains,
    solve,
    steadied,
)
from .working_point import WorkingPoint

Array = NDArray[np.float64]
Progress = Callable[[str, float], None]


@dataclass(frozen=True)
class HeldError:
    """Mean square errors of a free simulation, and what noise alone leaves of that."""

    squares: float
    floor: float


class Records(Fitted, Protocol):
    """Records to fit to, and records that choose nothing and are asked only whether they agree."""

    def held(self, point: WorkingPoint, candidates: Sequence[Candidate] = ()) -> list[Linearised]:
        """Return the records held out."""

    def held_error(self, point: WorkingPoint) -> HeldError:
        """Return how well they are simulated freely."""

    def believed(self, point: WorkingPoint) -> WorkingPoint:
        """Return the point with its noise as the records have it now."""


_MOST_EFFECTS = 6
_MOST_UNKNOWN = 4
_BEYOND_CHANCE = 6.0
"""Standard deviations by which held-out records must agree: one in 10^9 for a candidate."""
_PROMISING = 2.0
"""The same for an effect whose shape is a first guess: it is asked again once that is fitted."""
_STANDS_IN = 2e-3
"""Of what was there for two that fitted alike to it, what the first may take beside the second and
is only in its place: an equation that is right to a twentieth leaves as much."""
_SILENT = 3.0
"""Held-out records to which an effect does less than this, in the same measure, cannot be asked."""
_ALONE = 20.0
"""By how much blocks that did not fit it must then agree: they are of records that chose it."""
_WORTH = 0.004
"""An effect is worth naming if it takes this share of what noise does not explain."""
_IN_PASSING, _BESIDE = 1e-4, 1e-5
"""Of what other effects took, one that is named beside them must take this share: the first where
little is left, or the drives alone feel it. An equation that is right to a hundredth leaves as
much, wherever it leaves it; one that is right to a third of that the second."""
_LEAST = 40.0
"""Squared errors that a candidate must take at least: the best of hundreds takes 15 by chance."""
_SURVIVES = 0.35
_MOST_SURVIVORS = 5
"""Of the candidates, those that explain this share of what the best one does are fitted."""
_MOST_RANKED = 40
_VALLEY, _MOST_VALLEYS = 0.7, 2
"""From how many other shapes of its grid the best one is fitted too: from those that gain nearly as
much; where something happened once, a time that is not nearest tells nothing."""
_ALIKE = 0.02
_NEAR = 12.0
"""Fits whose squared errors differ by less than this share of what they gain are not told apart,
nor those that differ by less than three standard deviations."""
_PRICE = 4.0
"""Squared errors that a parameter must save to be worth it."""
_TRUST = 1e3
_TELLING = 0.8
_SIFTING_STEPS = 4
_LOWERS = 0.003
"""Share of the held-out records' mean square error, simulated freely, that an effect must take."""
_SAME = 1e-6
_MOST_REFUSED = 3
_EXPLAINED = 1.06
"""Mean square errors of the free simulation, over what noise leaves, at which a model explains the
records: 1.03 times the floor. A force that only the drives feel does not show there."""
_MUCH = 1.7
"""Mean square errors of the free simulation, over what noise leaves, that free forms are tried on:
1.3 times the floor."""
_GUESS = 0.3
"""A name that takes less than this share of what is left beside a free form was a guess."""


@dataclass(frozen=True)
class Tried:
    """A candidate beside the working point: what it gains in cross-validated squared errors.

    chance: how far beyond chance held-out records agree, or, where it does nothing in them (not
    `held`), blocks of the others that did not fit it.
    """

    effect: Effect
    shape: tuple[float, ...]
    gain: float
    blocks: Array
    amplitudes: tuple[float, ...]
    chance: float
    held: bool = True


@dataclass(frozen=True)
class Round:
    """One round of the search: what was left over before, the best candidates, what was taken.

    `elsewhere`: the survivors at other shapes of their grids.
    """

    excess: float
    count: float
    ranking: tuple[Tried, ...]
    survivors: tuple[Tried, ...]
    elsewhere: tuple[Tried, ...]
    taken: Tried | None
    alternatives: tuple[Tried, ...]


@dataclass(frozen=True)
class Found:
    """The working point at the end, how it was reached, and what both sets of records leave."""

    point: WorkingPoint
    rounds: tuple[Round, ...]
    covariance: Array
    train: Evidence
    held: Evidence


@dataclass(frozen=True)
class _Least:
    """What a candidate must take and how sure it must be, in squared errors.

    `excess` is what there is, `explained` what others took of it before; `little`: the free
    simulation is near what noise leaves.
    """

    excess: float
    explained: float
    little: bool

    def taken_by(self, tried: Tried) -> bool:
        """Return whether a candidate takes that."""
        surely = (_PROMISING if tried.shape else _BEYOND_CHANCE) if tried.held else _ALONE
        beside = _IN_PASSING if self.little or _internal(tried.effect) else _BESIDE
        worth = max(_WORTH * self.excess, beside * self.explained, _LEAST)
        return tried.chance > surely and tried.gain > worth


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
    point, error, rounds = _grown(point, effects, _MOST_EFFECTS, 0.0, error, records, progress)
    if point.disturbance.measured and error.squares > _MUCH * error.floor:
        named = point
        point, error, more = _grown(point, unknown, _MOST_UNKNOWN, _MUCH, error, records, progress)
        rounds += more
        if point is not named:
            point = _without_guesses(point, records)
    train, held = (gather(point, part) for part in (records.train(point), records.held(point)))
    own = list(range(train.gram.shape[1] - 1))
    spread = covariance(train.whole, own) / np.outer(train.size[:-1], train.size[:-1])
    return Found(_with_errors(point, spread, train), tuple(rounds), spread, train, held)


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
    candidates = [(effect, tuple(shape)) for effect in effects for shape in effect.grid]
    rounds: list[Round] = []
    barred = {p.effect.identity for p in point.placed}
    refused, most = 0, most + len(point.placed)
    while error.squares > enough * error.floor:
        if point.disturbance.measured and error.squares < _EXPLAINED * error.floor:
            candidates = [c for c in candidates if _internal(c[0])]
        progress(f"screening {len(candidates)} candidates", _share(len(rounds)))
        train = gather(point, records.train(point, candidates))
        held = gather(point, records.held(point, candidates))
        explained = rounds[0].excess - train.excess if rounds else 0.0
        little = error.squares < _MUCH * error.floor
        found = _round(point, candidates, train, held, _Least(train.excess, explained, little))
        if not found.survivors or len(point.placed) >= most or refused >= _MOST_REFUSED:
            rounds.append(found)
            break
        progress(
            f"fitting {', '.join(t.effect.name for t in found.survivors)}", _share(len(rounds))
        )
        found = _sifted(point, found, train, records)
        taken = found.taken
        assert taken is not None
        progress(f"adding {taken.effect.name}", _share(len(rounds)))
        better, squares = refine(_with(point, taken), records)
        taken = _asked_again(point, taken, better.placed[-1], records)
        better, squares, stood_in = _without_stand_in(better, squares, taken, rounds, records)
        found = replace(found, taken=taken)
        better = records.believed(_without_idle(_believing(better, squares, train), records))
        after = records.held_error(better)
        helps = after.squares < (1.0 - _LOWERS) * error.squares
        # What shows in the drives alone leaves the platform's motion as it was, but for parameters
        # that are fitted anew.
        aside = _internal(taken.effect) and after.squares < (1.0 + _LOWERS) * error.squares
        aside = aside or abs(after.squares - error.squares) < _SAME * error.squares
        agrees = taken.chance > (_BEYOND_CHANCE if taken.held else _ALONE)
        if agrees and squares < train.squares and (helps or aside):
            point, error = better, after
            barred |= {p.effect.identity for p in point.placed}
        else:
            found, stood_in = replace(found, taken=None), None
            barred.add(taken.effect.identity)
            refused += 1
        if stood_in is None:
            rounds.append(found)
        else:  # it is as if it had been taken then
            rounds[stood_in] = _taken_instead(rounds[stood_in], taken.effect.identity)
        candidates = [
            (effect, tuple(shape))
            for effect in effects
            if effect.identity not in barred
            for shape in effect.grid
        ]
    return point, error, rounds


def _without_stand_in(
    point: WorkingPoint,
    squares: float,
    taken: Tried,
    rounds: Sequence[Round],
    records: Records,
) -> tuple[WorkingPoint, float, int | None]:
    """Return the point without what was taken in place of the effect taken now, and in which round.

    Two that fitted alike to all that was there may differ in what is left: where the second is
    taken too, it may be enough by itself, begun as it fitted then.
    """
    for number, earlier in enumerate(rounds):
        rival = _rival(earlier, taken.effect.identity)
        if earlier.taken is None or rival is None:
            continue
        both = {taken.effect.identity, earlier.taken.effect.identity}
        others = tuple(p for p in point.placed if p.effect.identity not in both)
        if len(others) != len(point.placed) - 2:
            continue  # it has been given up since
        placed = Placed(rival.effect, rival.shape, rival.amplitudes)
        alone, left = refine(replace(point, placed=(*others, placed)), records)
        if left - squares < max(_STANDS_IN * earlier.excess, _LEAST):
            return alone, left, number
    return point, squares, None


def _rival(found: Round, identity: str) -> Tried | None:
    """Return the alternative of this identity, None if there is none."""
    return next((t for t in found.alternatives if t.effect.identity == identity), None)


def _taken_instead(found: Round, identity: str) -> Round:
    """Return the round with one of its alternatives taken, and what was taken an alternative."""
    rival = _rival(found, identity)
    assert found.taken is not None
    others = (t for t in found.alternatives if t is not rival)
    return replace(found, taken=rival, alternatives=(found.taken, *others))


def _without_guesses(point: WorkingPoint, records: Records) -> WorkingPoint:
    """Return the point without named effects that free-form forces make all but idle."""
    named = [p.effect.identity for p in point.placed if p.effect.effect_class != "unknown"]
    best = gather(point, records.train(point))
    for guess in named:
        others = tuple(p for p in point.placed if p.effect.identity != guess)
        fewer = replace(point, placed=others)
        fewer, squares = refine(fewer, records)
        if squares - best.squares < max(_GUESS * best.excess, _LEAST):
            point, best = fewer, gather(fewer, records.train(fewer))
    return point


def _believing(point: WorkingPoint, squares: float, evidence: Evidence) -> WorkingPoint:
    """Return the point with its trajectories as close to the model as the errors allow."""
    count = float(evidence.count.sum())
    wanted = float(np.clip(_TRUST * (squares / count - 1.0), 1.0, _TRUST))
    # In decades: filters are kept for each.
    return replace(point, trust=float(10.0 ** np.ceil(np.log10(wanted))))


def _share(rounds: int) -> float:
    return 0.85 - 0.7 * 0.6**rounds


def _with(point: WorkingPoint, tried: Tried) -> WorkingPoint:
    return replace(
        point, placed=(*point.placed, Placed(tried.effect, tried.shape, tried.amplitudes))
    )


def _sifted(point: WorkingPoint, found: Round, train: Evidence, records: Records) -> Round:
    """Return the round with its survivors fitted, and the best of them taken.

    A candidate that fits at a shape of the grid may fit better in between, so the fits decide. They
    use the records that tell most of the survivors.
    """
    best_tried = found.survivors[0]
    if not any(tried.shape for tried in found.survivors):
        # What has no shape to move is where a fit would leave it already.
        near = max(_ALIKE * best_tried.gain, _NEAR)
        alike = tuple(t for t in found.survivors[1:] if best_tried.gain - t.gain < near)
        return replace(found, taken=best_tried, alternatives=alike)
    if len(found.survivors) == 1 and not found.elsewhere:
        return replace(found, taken=best_tried)
    only = _telling(found.survivors, train)
    before = gather(point, records.train(point, only=only)).squares

    def fit(tried: Tried) -> tuple[float, Tried]:
        at, squares = refine(_with(point, tried), records, only, _SIFTING_STEPS)
        last = at.placed[-1]
        price = _PRICE * (len(last.amplitudes) + len(last.shape))
        return squares + price, replace(tried, shape=last.shape, amplitudes=last.amplitudes)

    fitted = sorted((fit(tried) for tried in found.survivors), key=lambda pair: pair[0])
    # A fit ends in the valley that it began in: the best one also begins elsewhere.
    identity = fitted[0][1].effect.identity
    again = [fit(t) for t in found.elsewhere if t.effect.identity == identity]
    fitted[0] = min(fitted[0], *again, key=lambda pair: pair[0]) if again else fitted[0]
    best, taken = fitted[0]
    near = max(_ALIKE * (before - best), _NEAR)
    alike = tuple(tried for squares, tried in fitted[1:] if squares - best < near)
    return replace(found, taken=taken, alternatives=alike)


def _telling(survivors: Sequence[Tried], train: Evidence) -> list[int]:
    """Return the numbers of the records in which the survivors gain most, most of it in all."""
    gain = np.zeros(int(train.record.max()) + 1)
    for tried in survivors:
        share = np.bincount(train.record, np.maximum(tried.blocks, 0.0), len(gain))
        gain += share / max(share.sum(), 1e-300)
    order = np.argsort(-gain)
    enough = np.searchsorted(np.cumsum(gain[order]), _TELLING * gain.sum()) + 1
    return sorted(order[: max(enough, 2)].tolist())


def _without_idle(point: WorkingPoint, records: Records) -> WorkingPoint:
    """Return the point without effects that those found after them have made idle."""
    if len(point.placed) < 2:
        return point
    train = steadied(gather(point, records.train(point)))
    at, base = len(point.parameters.names), list(range(train.gram.shape[1] - 1))
    full = cross_validated(train, base).sum()
    idle = []
    for p in point.placed:
        own = set(range(at, at + _width(p)))
        # Without it its errors come back: what its own columns would have to explain again.
        back = _restored(train, p, sorted(own), len(p.amplitudes))
        kept = [c for c in base if c not in own]
        if cross_validated(back, kept).sum() - full < _LEAST:
            idle.append(p)
        at += _width(p)
    if not idle:
        return point
    fewer, _ = refine(
        replace(point, placed=tuple(p for p in point.placed if p not in idle)), records
    )
    return fewer


def _restored(evidence: Evidence, placed: Placed, own: Sequence[int], amplitudes: int) -> Evidence:
    """Return the evidence with an effect's amplitudes set to nothing, to first order."""
    take = np.eye(evidence.gram.shape[1])
    columns = list(own)[:amplitudes]
    take[columns, -1] = -np.array(placed.amplitudes) * evidence.size[columns]
    gram = np.einsum("ji,bjk,kl->bil", take, evidence.gram, take, optimize=True)
    return replace(evidence, gram=gram, prior=take.T @ evidence.prior @ take)


def _round(
    point: WorkingPoint,
    candidates: Sequence[Candidate],
    train: Evidence,
    held: Evidence,
    least: _Least,
) -> Round:
    own = len(point.parameters.names) + sum(_width(p) for p in point.placed)
    gained = gains(train)
    in_order = sorted(range(len(candidates)), key=lambda i: -float(gained[i].sum()))

    def tried(i: int) -> Tried | None:
        effect, shape = candidates[i]
        joined = train.joined(i)
        columns = list(range(len(joined.size) - 1))
        coefficients = solve(joined.whole, columns) / joined.size[:-1]
        amplitudes = coefficients[own:].tolist()
        quantities = zip(amplitudes, effect.amplitudes, strict=True)
        if not all(q.low <= value <= q.high for value, q in quantities):
            return None  # a friction that drives is none
        agrees = _agrees(joined, held.joined(i), own, coefficients)
        gain = float(gained[i].sum())
        return Tried(effect, shape, gain, gained[i], tuple(amplitudes), *agrees)

    ranking: list[Tried] = []
    seen: set[str] = set()
    for i in in_order:
        identity = candidates[i][0].identity
        if identity not in seen and len(ranking) < _MOST_RANKED:
            seen.add(identity)
            ranking += filter(None, [tried(i)])
    excess, count = train.excess, float(train.count.sum())
    convincing = [t for t in ranking if least.taken_by(t)]
    survivors = [t for t in convincing if t.gain > _SURVIVES * convincing[0].gain]
    survivors = survivors[:_MOST_SURVIVORS]
    elsewhere: list[Tried] = []
    for best in survivors:
        rows = [
            i
            for i in in_order
            if candidates[i][0].identity == best.effect.identity
            and candidates[i][1] != best.shape
            and float(gained[i].sum()) > _VALLEY * best.gain
        ]
        elsewhere += filter(None, map(tried, rows[:_MOST_VALLEYS]))
    return Round(excess, count, tuple(ranking), tuple(survivors), tuple(elsewhere), None, ())


def _internal(effect: Effect) -> bool:
    """Return whether only the drives feel it: a force between the beam and the platform."""
    return effect.where == ("beam",)


def _asked_again(point: WorkingPoint, taken: Tried, fitted: Placed, records: Records) -> Tried:
    """Return what was taken at its fitted shape, with the chance that held-out records give it."""
    if not fitted.shape:
        return taken  # they were asked that
    candidate = [(fitted.effect, fitted.shape)]
    train = gather(point, records.train(point, candidate)).joined(0)
    held = gather(point, records.held(point, candidate)).joined(0)
    columns = list(range(len(train.size) - 1))
    coefficients = solve(train.whole, columns) / train.size[:-1]
    agrees, asked = _agrees(train, held, len(columns) - len(fitted.amplitudes), coefficients)
    return replace(
        taken, shape=fitted.shape, amplitudes=fitted.amplitudes, chance=agrees, held=asked
    )


def _agrees(train: Evidence, held: Evidence, own: int, coefficients: Array) -> tuple[float, bool]:
    """Return how far beyond chance others agree, and whether held-out records could be asked.

    The first `own` columns are what is there already.
    """
    columns = list(range(len(coefficients)))
    question = columns[:own], columns[own:], coefficients * held.size[:-1]
    if expected(held, *question) < _SILENT:
        return chance_between(train, columns[:own], columns[own:]), False
    return chance(held, *question), True


def _width(placed: Placed) -> int:
    return len(placed.amplitudes) + len(placed.shape)


def _with_errors(point: WorkingPoint, spread: Array, train: Evidence) -> WorkingPoint:
    """Return the point with standard errors, widened where the errors are larger than noise."""
    inflation = max(train.squares / float(train.count.sum()), 1.0)
    errors = np.sqrt(inflation * np.diag(spread))
    at, placed = len(point.parameters.names), []
    for p in point.placed:
        names = [q.name for q in (*p.effect.amplitudes, *p.effect.shape)]
        own = errors[at : at + len(names)]
        placed.append(replace(p, standard_errors=dict(zip(names, own.tolist(), strict=True))))
        at += len(names)
    return replace(point, placed=tuple(placed))
