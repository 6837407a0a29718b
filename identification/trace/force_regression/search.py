"""Search for effects in the missing force: add what blocks and other records confirm.

One criterion decides whether an effect stays: the squared error that it takes of blocks that did
not fit it is larger than its standard error by far, matters, and is not contradicted by another
record. Among effects that the records do not tell apart the one with the fewest numbers is taken;
the others are its alternatives. The laws of friction of one DOF exclude each other: a richer one
takes the place of a simpler one if it is confirmed beside the model with the simpler one.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ....model.effects.base import Effect, Placed
from ..search_options import SearchOptions
from .candidate_fit import Beside, fitted_candidate, taken_at
from .force_record import ForceModel
from .held_out_gain import (
    Blocks,
    Columns,
    Gain,
    block_sums,
    bounded,
    error_of_mean,
    fitted,
    gain_of,
)
from .training_records import Training, acting_force, missing_share, numbers_of

Array = NDArray[np.float64]
Progress = Callable[[str, float], None]

_ONE_LAW = "friction"
"""Class of which a DOF has one law."""


@dataclass(frozen=True)
class Rated:
    """A candidate with fitted numbers, and its gain over the model at that time.

    share
    and force: the part of the squared missing force that it takes, and by how much it lowers the
    RMS missing force over the acting force, at the DOF where that is most. instead_of: the effect
    whose place it takes. contenders: all that were fitted in the same round. `alternatives` are not
    told apart from it. support: share of bootstrap samples of the blocks in which one of its class
    and place gains most of all.
    """

    placed: Placed
    gain: Gain
    share: float
    force: float
    instead_of: Placed | None = None
    support: float = float("nan")
    alternatives: tuple[Rated, ...] = ()
    contenders: tuple[Effect, ...] = ()

    @property
    def numbers(self) -> int:
        """Amplitudes and shape parameters."""
        return numbers_of(self.placed)


@dataclass(frozen=True)
class Searched:
    """The model with the effects found, how each was rated, what came nearest, what was dropped."""

    point: ForceModel
    rated: tuple[Rated, ...]
    nearest: tuple[Rated, ...]
    dropped: tuple[str, ...]


def search(
    point: ForceModel,
    named: Sequence[Effect],
    free_forms: Sequence[Effect],
    training: Training,
    options: SearchOptions,
    progress: Progress,
) -> Searched:
    """Add effects to a fitted model until none is confirmed; free forms where no named one is."""
    state = _State(point, {}, ())
    nearest: list[Rated] = []
    for number in range(1, options.most_effects + 1):
        progress(f"search, effect {number}", 0.1 + 0.1 * number)
        nearest = _ranking(state, named, training, options)
        after = _with_best(state, nearest, training, options)
        if after is None:
            ranking = _ranking(state, free_forms, training, options)
            after = _with_best(state, ranking, training, options)
            nearest = sorted([*nearest, *ranking], key=_order)
        if after is None:
            break
        state = _without_idle(after, training, options)
    progress("comparing rivals", 0.8)
    state = _against_rivals(state, training, options)
    last = {p.effect.identity: p for p in state.point.placed}
    final = [replace(r, placed=last[key]) for key, r in state.rated.items()]
    final.sort(key=lambda r: (_free(r.placed), -r.force))
    gone = tuple(name for name in state.dropped if name not in last)
    return Searched(state.point, tuple(final), tuple(nearest[:3]), gone)


def confirmed(rated: Rated, options: SearchOptions) -> bool:
    """Return whether an effect is no chance, matters, and is not contradicted elsewhere.

    A free form names no law that would hold elsewhere, so other records must confirm it.
    """
    gain = rated.gain
    surely = gain.statistic > options.standard_errors
    least = options.least_free_gain if _free(rated.placed) else options.least_gain
    matters = rated.share > least and rated.force > options.least_force
    asked = not _free(rated.placed) or bool(np.all(np.isfinite(gain.others)))
    return surely and matters and asked and gain.elsewhere


def rate(
    point: ForceModel,
    candidates: Sequence[Effect],
    training: Training,
    options: SearchOptions,
    instead_of: Placed | None = None,
) -> list[Rated]:
    """Return the candidates that gain most, with fitted numbers, best first.

    instead_of: the effect of the point whose place they take; their gain is that over the point.
    """
    if not candidates:
        return []
    whole = Beside.of(point, training)
    rest = whole
    if instead_of is not None:
        others = tuple(p for p in point.placed if p is not instead_of)
        rest = Beside.of(replace(point, placed=others), training)
    screened = []
    for effect in candidates:
        taken = [(taken_at(rest, effect, s, options.told_from_model), s) for s in effect.grid]
        best = max(((t, s) for t, s in taken if t is not None), default=None)
        if best is not None:
            screened.append((best[0], effect, best[1]))
    screened.sort(key=lambda s: -s[0])
    found = []
    for _, effect, shape in screened[: options.fitted]:
        placed = fitted_candidate(rest, effect, shape, options.told_from_model)
        if placed is not None:
            found.append(rated_beside(whole, rest, placed, instead_of))
    return sorted(found, key=_order)


@dataclass(frozen=True)
class _State:
    """The model so far, the ratings of its found effects by identity, and dropped ones."""

    point: ForceModel
    rated: dict[str, Rated]
    dropped: tuple[str, ...]


def _ranking(
    state: _State, table: Sequence[Effect], training: Training, options: SearchOptions
) -> list[Rated]:
    point = state.point
    fresh = [e for e in table if e.identity not in state.dropped]
    ranking = rate(point, _new(fresh, point.placed), training, options)
    for p in point.placed:
        if p.effect.effect_class == _ONE_LAW:
            same = [e for e in fresh if e.effect_class == _ONE_LAW and e.where == p.effect.where]
            ranking += rate(point, same, training, options, p)
    return sorted(ranking, key=_order)


def _with_best(
    state: _State, ranking: Sequence[Rated], training: Training, options: SearchOptions
) -> _State | None:
    """Return the state with the best confirmed candidate whose fit does what was foretold."""
    plain = training.plain()
    before = missing_share(plain.at(state.point))
    first = next((r for r in ranking if confirmed(r, options)), None)
    if first is None:
        return None
    kept = tuple(p for p in state.point.placed if p is not first.instead_of)
    beside = replace(state.point, placed=kept)
    for chosen, point in _fitted_rivals(beside, first, ranking, training, options):
        lowered = before - missing_share(plain.at(point))
        if lowered.max() > options.least_force:
            rated = {
                key: r
                for key, r in state.rated.items()
                if first.instead_of is None or key != first.instead_of.effect.identity
            }
            rated[chosen.placed.effect.identity] = chosen
            return _State(point, rated, state.dropped)
    return None


def _new(table: Sequence[Effect], placed: Sequence[Placed]) -> list[Effect]:
    """Return the effects of a table that may act beside those of a model."""
    known = {p.effect.identity for p in placed}
    rubbed = {w for p in placed if p.effect.effect_class == _ONE_LAW for w in p.effect.where}
    fresh = [e for e in table if e.identity not in known]
    return [e for e in fresh if e.effect_class != _ONE_LAW or not rubbed.intersection(e.where)]


def _fitted_rivals(
    beside: ForceModel,
    first: Rated,
    ranking: Sequence[Rated],
    training: Training,
    options: SearchOptions,
) -> list[tuple[Rated, ForceModel]]:
    """Return the confirmed candidates with the fitted model of each, the one to take first.

    `beside` is the model without them. Gains are foretold by a line, and a large effect moves the
    model's other numbers: so candidates are compared where the fit with each of them ends. What is
    not surely worse than the best is not told apart from it. Of these the one with the fewest
    numbers comes first, and has the others as its alternatives, but for richer laws at its place: a
    richer law contains most simpler ones. Then come the others, best first.
    """
    rivals = [r for r in ranking if r.instead_of is first.instead_of and confirmed(r, options)]
    fitted = list[_Fitted]()
    for rated in rivals:  # best first: most others soon prove to stay behind
        least = min((f.cost for f in fitted), default=0.0)
        fitted.append(_Fitted.of(beside, rated, training, least))
    fitted.sort(key=lambda f: float(f.errors.sum()))
    alike = [f for f in fitted if not _worse(f, fitted[0], training.blocks, options)]
    alike.sort(key=lambda f: f.rated.numbers)
    support = _support(fitted, ranking, options)
    named = [replace(f.rated, support=support(f.rated)) for f in alike]
    contenders = tuple(r.placed.effect for r in ranking)
    others = tuple(r for r in named[1:] if not _richer(r, named[0]))
    best = replace(named[0], alternatives=others, contenders=contenders)
    rest = [f for f in fitted if f is not alike[0]]
    told = [replace(f.rated, support=support(f.rated), contenders=contenders) for f in rest]
    return [(best, alike[0].point), *zip(told, (f.point for f in rest), strict=True)]


def _richer(one: Rated, other: Rated) -> bool:
    """Return whether one has more numbers at the same place."""
    same = one.placed.effect.where == other.placed.effect.where
    return same and one.numbers > other.numbers


@dataclass(frozen=True)
class _Fitted:
    """A candidate where the fit of the whole model with it ends.

    errors (B,): squared error of each block by the fit of all others, with the candidate's shape
    held. left: what remains of the weighed missing force of each record (rows, n).
    """

    rated: Rated
    point: ForceModel
    cost: float
    errors: Array
    left: tuple[Array, ...]

    @classmethod
    def of(cls, beside: ForceModel, rated: Rated, training: Training, least: float) -> _Fitted:
        """Fit the model with a candidate; not to the end if it stays far above the least cost."""
        point = training.fit(replace(beside, placed=(*beside.placed, rated.placed)), least)
        at = training.at(point)
        columns = training.columns(at)
        judged = training.judged(at, columns, training.group_columns(at))
        last = replace(rated, placed=point.placed[-1])
        # A shape that the records hardly determine would move far by a fit without a block.
        kept = len(columns[0]) - len(last.placed.shape)
        held = judged.only(range(kept))
        left = _left(_coefficients(held), [c[:kept] for c in columns], at.missing)
        return cls(last, point, training.cost(point), held.left_out_errors(), tuple(left))


def _worse(one: _Fitted, best: _Fitted, blocks: Blocks, options: SearchOptions) -> bool:
    """Return whether a fitted candidate is worse: surely, by the scatter of the difference, and by
    more than the equation of the best may be wrong by."""
    size = block_sums(blocks, [a - b for a, b in zip(one.left, best.left, strict=True)])
    difference = bounded(one.errors - best.errors, size)
    least = options.inexact * float(best.rated.gain.raw.mean())
    surely = options.standard_errors * error_of_mean(difference, size)
    return bool(difference.mean() > max(surely, least))


def _support(
    fitted: Sequence[_Fitted], ranking: Sequence[Rated], options: SearchOptions
) -> Callable[[Rated], float]:
    """Return the function that gives the share of resamples of the blocks in which the class and
    place of a candidate gain most of all."""
    gains = np.array([r.gain.raw for r in ranking])
    errors = np.array([f.errors for f in fitted])
    rng = np.random.default_rng(0)
    picks = rng.integers(errors.shape[1], size=(options.resamples, errors.shape[1]))
    wins = np.argmin(errors[:, picks].mean(axis=2), axis=0)
    none = np.all(gains[:, picks].mean(axis=2) <= 0.0, axis=0)

    def kind(rated: Rated) -> tuple[str, tuple[str, ...]]:
        return rated.placed.effect.effect_class, rated.placed.effect.where

    kinds = [kind(f.rated) for f in fitted]

    def share(rated: Rated) -> float:
        same = [i for i, other in enumerate(kinds) if other == kind(rated)]
        return float(np.mean(np.isin(wins, same) & ~none))

    return share


def rated_beside(whole: Beside, rest: Beside, placed: Placed, instead_of: Placed | None) -> Rated:
    """Return the gain of an effect beside `rest` over the model of `whole`."""
    training, more = rest.training, numbers_of(placed)
    columns = _beside(rest, placed)
    before = training.judged(whole.at, whole.own, whole.groups)
    after = training.judged(rest.at, columns, training.group_columns(rest.at, placed), more)
    base, amplitudes = len(rest.own[0]), len(placed.amplitudes)
    found = _coefficients(before), _coefficients(after)
    left = [
        _left(found[0], whole.own, whole.at.missing),
        _left(found[1], columns, rest.at.missing),
    ]
    change = [one - other for one, other in zip(*left, strict=True)]
    size = block_sums(training.blocks, change)
    gain = gain_of(before, after, size, base, amplitudes, training.blocks.record)
    force = _force_share(whole, rest, placed, found)
    return Rated(placed, gain, gain.share, force, instead_of)


def _force_share(
    whole: Beside, rest: Beside, placed: Placed, coefficients: tuple[Array, Array]
) -> float:
    """Return by how much an effect lowers the RMS missing force, over the acting force.

    It is without weights, and the largest of all DOF. `coefficients` are those of both models,
    fitted with weights.
    """
    plain = whole.training.plain()
    one, other = plain.at(whole.at.point), plain.at(rest.at.point)
    more = plain.effect_columns(other, placed)
    columns = [np.concatenate(pair) for pair in zip(plain.columns(other), more, strict=True)]
    before = _left(coefficients[0], plain.columns(one), one.missing)
    after = _left(coefficients[1], columns, other.missing)
    sizes = [
        np.sqrt(np.sum([np.sum(x * x, axis=0) for x in values], axis=0))
        for values in (before, after)
    ]
    forces = np.maximum(acting_force(one), np.finfo(float).tiny)
    return float(np.max((sizes[0] - sizes[1]) / forces))


def _beside(rest: Beside, placed: Placed) -> list[Array]:
    """Return the columns of a model and one more effect, each record (C, rows, n)."""
    more = rest.training.effect_columns(rest.at, placed)
    return [np.concatenate(pair) for pair in zip(rest.own, more, strict=True)]


def _coefficients(columns: Columns) -> Array:
    return fitted(columns.grams.sum(axis=(0, 1)), columns.prior)


def _left(coefficients: Array, columns: Sequence[Array], missing: Sequence[Array]) -> list[Array]:
    """Return what columns leave of the missing force of each record."""
    return [m - np.tensordot(coefficients, c, 1) for c, m in zip(columns, missing, strict=True)]


def _without_idle(state: _State, training: Training, options: SearchOptions) -> _State:
    """Remove found effects that the criterion no longer confirms beside the others.

    A law is judged without the free forms, which contain most laws; a free form beside all.
    """
    while len(state.rated) > 1:
        idle = []
        for p in state.point.placed:
            if p.effect.identity in state.rated:
                others = tuple(
                    o for o in state.point.placed if o is not p and (_free(p) or not _free(o))
                )
                rest = Beside.of(replace(state.point, placed=others), training)
                rated = rated_beside(rest, rest, p, None)
                if not confirmed(rated, options):
                    idle.append((rated.gain.statistic, p))
        if not idle:
            break
        _, worst = min(idle, key=lambda pair: pair[0])
        state = _removed(state, worst, training)
    return state


def _order(rated: Rated) -> float:
    return -float(rated.gain.raw.mean())


def _free(placed: Placed) -> bool:
    return placed.effect.effect_class == "unknown"


def _removed(state: _State, placed: Placed, training: Training) -> _State:
    identity = placed.effect.identity
    rated = {k: r for k, r in state.rated.items() if k != identity}
    kept = tuple(p for p in state.point.placed if p is not placed)
    point = training.fit(replace(state.point, placed=kept))
    return _State(point, rated, (*state.dropped, identity))


def _against_rivals(state: _State, training: Training, options: SearchOptions) -> _State:
    """Compare each found effect with its rivals beside all others; take the best or simplest."""
    for identity, rated in list(state.rated.items()):
        own = next((p for p in state.point.placed if p.effect.identity == identity), None)
        if own is None or _free(own) or len(state.rated) < 2:
            continue
        kept = tuple(p for p in state.point.placed if p is not own)
        rivals = [own.effect, *_new(rated.contenders, kept)]
        rivals = list({e.identity: e for e in rivals}.values())
        rest = training.fit(replace(state.point, placed=kept))
        ranking = rate(rest, rivals, training, options)
        first = next((r for r in ranking if confirmed(r, options)), None)
        if first is None:
            continue
        best, point = _fitted_rivals(rest, first, ranking, training, options)[0]
        others = {k: r for k, r in state.rated.items() if k != identity}
        others[best.placed.effect.identity] = best
        state = _State(point, others, state.dropped)
    return state
