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

    left: what the model with it leaves of the weighed missing force of each record (rows, n). share
    and force: the part of the squared missing force that it takes, and by how much it lowers the
    RMS missing force over the acting force, at the DOF where that is most. instead_of: the effect
    whose place it takes. contenders: all that were fitted in the same round. `alternatives` are not
    told apart from it. support: share of bootstrap samples of the blocks in which one of its class
    and place gains most of all.
    """

    placed: Placed
    gain: Gain
    left: tuple[Array, ...]
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
    """Return the state with the best confirmed candidate whose fit does what was foretold.

    Gains are foretold by a line; the fit of all numbers may end elsewhere.
    """
    plain = training.plain()
    before = missing_share(plain.at(state.point))
    for chosen in ranking:
        if confirmed(chosen, options):
            after = _with(state, chosen, ranking, training, options)
            lowered = before - missing_share(plain.at(after.point))
            if lowered.max() > options.least_force:
                return after
    return None


def _new(table: Sequence[Effect], placed: Sequence[Placed]) -> list[Effect]:
    """Return the effects of a table that may act beside those of a model."""
    known = {p.effect.identity for p in placed}
    rubbed = {w for p in placed if p.effect.effect_class == _ONE_LAW for w in p.effect.where}
    fresh = [e for e in table if e.identity not in known]
    return [e for e in fresh if e.effect_class != _ONE_LAW or not rubbed.intersection(e.where)]


def _with(
    state: _State,
    chosen: Rated,
    ranking: Sequence[Rated],
    training: Training,
    options: SearchOptions,
) -> _State:
    """Return the state with the simplest of those that are not told apart from `chosen`."""
    best = with_alternatives(chosen, ranking, training.blocks, options)
    kept = tuple(p for p in state.point.placed if p is not best.instead_of)
    rated = dict(state.rated)
    if best.instead_of is not None:
        rated.pop(best.instead_of.effect.identity, None)
    rated[best.placed.effect.identity] = best
    point = training.fit(replace(state.point, placed=(*kept, best.placed)))
    return _State(point, rated, state.dropped)


def with_alternatives(
    chosen: Rated, ranking: Sequence[Rated], blocks: Blocks, options: SearchOptions
) -> Rated:
    """Return the simplest of those that are not told from `chosen`, with the others beside it."""
    alike = [
        r
        for r in ranking
        if r is chosen or (r.instead_of is chosen.instead_of and _alike(chosen, r, blocks))
    ]
    alike = [r for r in alike if confirmed(r, options)]
    first = min(alike, key=lambda r: (r.numbers, _order(r)))
    rng = np.random.default_rng(0)
    gains = np.array([r.gain.raw for r in ranking])
    picks = rng.integers(gains.shape[1], size=(options.resamples, gains.shape[1]))
    means = gains[:, picks].mean(axis=2)
    wins = np.where(means.max(axis=0) > 0.0, np.argmax(means, axis=0), -1)
    kinds = [(r.placed.effect.effect_class, r.placed.effect.where) for r in ranking]
    won = [float(np.mean(wins == i)) for i in range(len(ranking))]
    named = {
        id(r): sum(w for w, other in zip(won, kinds, strict=True) if other == kind)
        for r, kind in zip(ranking, kinds, strict=True)
    }
    others = tuple(replace(r, support=named[id(r)]) for r in alike if r is not first)
    contenders = tuple(r.placed.effect for r in ranking)
    return replace(first, support=named[id(first)], alternatives=others, contenders=contenders)


def _alike(best: Rated, other: Rated, blocks: Blocks) -> bool:
    """Return whether two candidates gain alike, within the scatter of their difference."""
    change = [one - two for one, two in zip(best.left, other.left, strict=True)]
    size = block_sums(blocks, change)
    difference = bounded(best.gain.raw - other.gain.raw, size)
    return bool(difference.mean() <= error_of_mean(difference, size))


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
    return Rated(placed, gain, tuple(left[1]), gain.share, force, instead_of)


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
        chosen = next((r for r in ranking if confirmed(r, options)), None)
        if chosen is None:
            continue
        best = with_alternatives(chosen, ranking, training.blocks, options)
        others = {k: r for k, r in state.rated.items() if k != identity}
        others[best.placed.effect.identity] = best
        point = training.fit(replace(rest, placed=(*kept, best.placed)))
        state = _State(point, others, state.dropped)
    return state
