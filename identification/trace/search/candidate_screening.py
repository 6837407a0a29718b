"""Screen candidates by regression, and test the best ones on held-out records."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from ....model.effects.base import Effect, Placed
from ....model.effects.freeform import depends_on
from ..linearised.gram_matrices import Linearised
from ..linearised.linearisation_point import WorkingPoint
from .gauss_newton import Candidate, Fitted, gather
from .regression import FOLDS, ColumnEvidence, chance, chance_between, expected, gains, solve

Array = NDArray[np.float64]

BEYOND_CHANCE = 6.0
"""Standard deviations by which held-out records must agree: one in 10^9 for a candidate."""
_PROMISING = 2.0
"""The same for an effect whose shape is a first guess: it is asked again once that is fitted."""
_SILENT, _CONTRADICTS = 3.0, 3.0
"""Held-out records to which an effect does less than this, in the same measure, cannot be asked.
Those to which it does little more can hardly agree by BEYOND_CHANCE, but by so much less than is
expected of them they contradict."""
ALONE = 20.0
"""By how much blocks that did not fit it must then agree: they are of records that chose it."""
_PROMISING_ALONE = 6.0
"""The same for an effect whose shape is a first guess. A dead zone at two thirds of its width took
two thirds of the errors and agreed by 8, and at its width by some thousand."""
_MOST_OF_IT = 0.5
"""Who explains this share of what there is at a first guess is fitted whatever held-out records
say: where the right shape does nothing in them a wrong one does, and they contradict that."""
FRICTION = "friction"
_WORTH = 0.004
"""An effect is worth naming if it takes this share of what noise does not explain."""
DESCRIBES = 0.1
"""A free form is worth having if it takes this: it names nothing. What is random lets one follow a
little of it, and so does what an equation of a hysteresis leaves of another one, some 5 %."""
AT_FIRST = 0.3
"""Of that, as much is enough for a first guess of its shape: it is asked again when fitted."""
_IN_PASSING, _BESIDE = 1e-4, 1e-5
"""Of what other effects took, one that is named beside them must take this share: the first where
little is left, or the drives alone feel it. An equation that is right to a hundredth leaves as
much, wherever it leaves it; one that is right to a third of that the second."""
_ANOTHER_LAW = 2.5e-3
"""Of what an equation of friction took, as much stays of another law of it that is alike to a
twentieth: no name and no form at its place takes less."""
LEAST = 40.0
"""Squared errors that a candidate must take at least: the best of hundreds takes 15 by chance."""
_SURVIVES = 0.35
_MOST_SURVIVORS = 5
"""Of the candidates, those that explain this share of what the best one does are fitted."""
_MOST_RANKED = 40
_VALLEY, _MOST_VALLEYS = 0.7, 2
"""From how many other shapes of its grid the best one is fitted too: from those that gain nearly as
much; where something happened once, a time that is not nearest tells nothing."""


@dataclass(frozen=True)
class HeldError:
    """Mean square free-run error, and its noise floor."""

    squares: float
    floor: float


class Records(Fitted, Protocol):
    """The training records, and the held-out records of the test."""

    @property
    def sensor_shape(self) -> Array:
        """Sensor matrix (S, n): readings of a rigid pose."""

    def held(self, point: WorkingPoint, candidates: Sequence[Candidate] = ()) -> list[Linearised]:
        """Return the held-out records, linearised."""

    def shown(self, point: WorkingPoint, candidates: Sequence[Candidate]) -> list[Linearised]:
        """Return the training records, with sensor candidates in the non-rigid readings only."""

    def held_error(self, point: WorkingPoint) -> HeldError:
        """Return the free-run error of the held-out records."""

    def with_estimated_noise(self, point: WorkingPoint) -> WorkingPoint:
        """Return the point with its noise estimated anew."""

    def noise_removed(self, point: WorkingPoint) -> Array:
        """Return the squared errors of noise that effects remove, by block of training records."""


@dataclass(frozen=True)
class Tried:
    """A tested candidate, with its gain in cross-validated squared errors.

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
    """One round of the search: residual before, best candidates, accepted effect.

    `elsewhere`: the survivors at other shapes of their grids. instead_of: what had been taken, and
    led less far. shares: of resamples of the blocks in which each of [taken, *alternatives] fits
    best; empty before the final comparison.
    """

    excess: float
    count: float
    ranking: tuple[Tried, ...]
    survivors: tuple[Tried, ...]
    elsewhere: tuple[Tried, ...]
    taken: Tried | None
    alternatives: tuple[Tried, ...]
    instead_of: Effect | None = None
    shares: tuple[float, ...] = ()


@dataclass(frozen=True)
class Least:
    """The least gain and significance of a candidate, in squared errors.

    `excess` is what there is, `explained` what others took of it before; `little`: the free
    simulation is near what noise leaves. visible: where that of the held-out records has nothing
    left to explain, what an effect of the platform that they know must take; 0 otherwise. rubbed:
    what friction on each DOF takes.
    """

    excess: float
    explained: float
    little: bool
    visible: float
    rubbed: Mapping[str, float] = field(default_factory=dict)

    def taken_by(self, tried: Tried) -> bool:
        """Return whether a candidate reaches both limits."""
        describes = DESCRIBES * (AT_FIRST if tried.shape else 1.0)
        if tried.effect.effect_class == "unknown" and tried.gain < describes * self.excess:
            return False
        at_first, at_last = (_PROMISING, BEYOND_CHANCE) if tried.held else (_PROMISING_ALONE, ALONE)
        surely = at_first if tried.shape else at_last
        if tried.shape and tried.gain > _MOST_OF_IT * self.excess:
            surely = -np.inf
        beside = _IN_PASSING if self.little or is_internal(tried.effect) else _BESIDE
        worth = max(_WORTH * self.excess, beside * self.explained, LEAST)
        if tried.held and not is_internal(tried.effect):
            worth = max(worth, self.visible)
        if tried.effect.effect_class != FRICTION:
            rubbed = max((self.rubbed.get(w, 0.0) for w in tried.effect.where), default=0.0)
            worth = max(worth, _ANOTHER_LAW * rubbed)
        return tried.chance > surely and tried.gain > worth


def screened(
    point: WorkingPoint,
    candidates: Sequence[Candidate],
    train: ColumnEvidence,
    records: Records,
    least: Least,
) -> Round:
    """Rank all candidates by their gain; return a round without an accepted effect.

    Their columns are in `train` in their order, behind those of the point. The records held out are
    asked about those that explain most, and have no columns of the others.
    """
    own = len(point.parameters.names) + sum(width(p) for p in point.placed)
    gained = gains(train)
    total = [gain if np.isfinite(gain) else -np.inf for gain in (float(g.sum()) for g in gained)]
    in_order = sorted(range(len(candidates)), key=lambda i: -_told(candidates[i][0], total[i]))

    def fitted(i: int) -> Array | None:
        if not np.isfinite(total[i]):
            return None
        effect, joined = candidates[i][0], train.joined(i)
        columns = list(range(len(joined.size) - 1))
        coefficients = solve(joined.whole, columns) / joined.size[:-1]
        # A friction that drives is none. Too much of an effect may be the right one of another
        # shape: the fit will tell.
        values = list(zip(coefficients[own:], effect.amplitudes, strict=True))
        right = all(q.low <= value and (effect.shape or value <= q.high) for value, q in values)
        return coefficients if right else None

    def tried(i: int, coefficients: Array, chance: float, asked: bool) -> Tried:
        effect = candidates[i][0]
        amplitudes = tuple(
            float(np.clip(value, q.low, q.high))
            for value, q in zip(coefficients[own:], effect.amplitudes, strict=True)
        )
        return Tried(*candidates[i], total[i], gained[i], amplitudes, chance, asked)

    ranked: list[tuple[int, Array]] = []
    seen: set[str] = set()
    for i in in_order:
        identity = candidates[i][0].identity
        if identity not in seen and len(ranked) < _MOST_RANKED:
            coefficients = fitted(i)
            if coefficients is not None:
                seen.add(identity)
                ranked.append((i, coefficients))
    others = gather(point, records.held(point, [candidates[i] for i, _ in ranked]))
    ranking = [
        tried(i, found, *_agrees(train.joined(i), others.joined(n), own, found))
        for n, (i, found) in enumerate(ranked)
    ]
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
            and total[i] > _VALLEY * best.gain
        ][:_MOST_VALLEYS]
        # Others are asked about these where one of them is fitted and taken.
        for i in rows:
            coefficients = fitted(i)
            if coefficients is not None:
                elsewhere.append(tried(i, coefficients, best.chance, best.held))
    excess, count = train.excess, float(train.count.sum())
    return Round(excess, count, tuple(ranking), tuple(survivors), tuple(elsewhere), None, ())


def asked_again(point: WorkingPoint, taken: Tried, fitted: Placed, records: Records) -> Tried:
    """Repeat the held-out test of the accepted effect at its fitted shape."""
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


def regressed(
    train: ColumnEvidence, number: int, effect: Effect, shape: tuple[float, ...], blocks: Array
) -> Tried:
    """Return candidate `number` of the evidence with its amplitudes by regression, untested.

    `blocks` (B,) is its gain.
    """
    joined = train.joined(number)
    found = solve(joined.whole, list(range(len(joined.size) - 1))) / joined.size[:-1]
    pairs = zip(found[-len(effect.amplitudes) :], effect.amplitudes, strict=True)
    amplitudes = tuple(float(np.clip(a, q.low, q.high)) for a, q in pairs)
    return Tried(effect, shape, float(blocks.sum()), blocks, amplitudes, np.inf)


def is_internal(effect: Effect) -> bool:
    """Return whether an effect acts on the drives only: a force between beam and platform."""
    return effect.where == ("beam",)


def _told(effect: Effect, gain: float) -> float:
    """Return a candidate's gain, reduced by a tenth for a free form of two signals.

    A product has room for what one of its factors does alone, and for chance. What it explains more
    than that has to be worth describing by itself.
    """
    products = effect.effect_class == "unknown" and len(depends_on(effect)) > 1
    return gain * (1.0 - DESCRIBES) if products else gain


def width(placed: Placed) -> int:
    """Return the number of parameters of an effect: amplitudes and shape."""
    return len(placed.amplitudes) + len(placed.shape)


def _agrees(
    train: ColumnEvidence, held: ColumnEvidence, own: int, coefficients: Array
) -> tuple[float, bool]:
    """Return the significance of the agreement, and whether held-out records gave it.

    The first `own` columns are what is there already.
    """
    columns = list(range(len(coefficients)))
    question = columns[:own], columns[own:], coefficients * held.size[:-1]
    shown = expected(held, *question)
    if shown < _SILENT:
        return chance_between(train, columns[:own], columns[own:]), False
    agrees = chance(held, *question)
    few = held.blocks < FOLDS
    if not few and (agrees > BEYOND_CHANCE or shown > BEYOND_CHANCE + _CONTRADICTS):
        return agrees, True
    between = chance_between(train, columns[:own], columns[own:])
    if few:
        return min(agrees, between), True
    if between > ALONE and agrees > shown - _CONTRADICTS:
        return between, False
    return agrees, True
