"""Rate candidates beside a model: fitted numbers, gain in blocks that did not fit them, force."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import islice

import numpy as np
from numpy.typing import NDArray

from ....model.effects.actuator_chain import same_law
from ....model.effects.base import Effect, Placed
from ...rounding import TINY
from ..force_balance.force_record import ForceModel
from ..force_balance.free_numbers import Shape, numbers_of
from ..force_regression.candidate_fit import Beside, fitted_candidate, taken_at, told_share
from ..force_regression.held_out_gain import Blocks, Columns, Gain, block_sums, gain_of
from ..force_regression.training_records import Training, acting_force
from ..search_options import SearchOptions

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Rated:
    """A candidate with fitted numbers, and its gain over the model at that time.

    force: by how much it lowers the RMS missing force over the acting force, at the DOF where that
    is most. instead_of: the effect whose place it takes. contenders: all that were fitted in the
    same round. `alternatives` are not told apart from it. support: share of bootstrap samples of
    the blocks in which one of its class and place gains most of all. idle: how many of its
    amplitudes could be zero, each by itself, where the fit of the whole model with it ends.
    """

    placed: Placed
    gain: Gain
    force: float
    instead_of: Placed | None = None
    support: float = float("nan")
    alternatives: tuple[Rated, ...] = ()
    contenders: tuple[Effect, ...] = ()
    idle: int = 0

    @property
    def share(self) -> float:
        """Part of the squared missing force that it takes, at the DOF where that is most."""
        return self.gain.share

    @property
    def free(self) -> bool:
        """Whether it is a free form, not a known law."""
        return is_free(self.placed)

    @property
    def numbers(self) -> int:
        """Amplitudes and shape parameters."""
        return numbers_of(self.placed)

    @property
    def as_simpler(self) -> bool:
        """Whether it could do without an amplitude, and is a simpler law then."""
        return self.idle > 0 and bool(self.placed.effect.contains)


def confirmed(rated: Rated, options: SearchOptions) -> bool:
    """Return whether an effect is no chance, matters, and is not contradicted elsewhere.

    A free form names no law that would hold elsewhere, so others must confirm it in two records.
    """
    asked = not rated.free or int(np.isfinite(rated.gain.others).sum()) > 1
    return confirmed_here(rated, options) and asked and rated.gain.elsewhere


def confirmed_here(rated: Rated, options: SearchOptions) -> bool:
    """Return whether an effect is no chance and matters, whatever each record says of it."""
    return rated.gain.statistic > options.standard_errors and matters(rated, options)


def matters(rated: Rated, options: SearchOptions) -> bool:
    """Return whether what an effect takes is large enough to matter, if it is no chance."""
    least = options.least_free_gain if rated.free else options.least_gain
    return rated.share > least and rated.force > options.least_force


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
        told = told_share(effect, options)
        taken = [(taken_at(rest, effect, s, told), s) for s in _starts(effect, instead_of)]
        starts = sorted(((t, s) for t, s in taken if t is not None), reverse=True)
        if starts:
            screened.append((starts[0][0], effect, _begins(effect, [s for _, s in starts])))
    screened.sort(key=lambda s: -s[0])
    distinct = [
        one
        for i, one in enumerate(screened)
        if not any(same_law(one[1], better[1]) for better in screened[:i])
    ]
    found = []
    for _, effect, shapes in distinct[: options.fitted]:
        told = told_share(effect, options)
        fits = [fitted_candidate(rest, effect, shape, told) for shape in shapes]
        kept = [p for p in fits if p is not None and not p.lacks_its_own_force]
        if kept:
            placed = max(kept, key=lambda p: taken_at(rest, effect, p.shape, told) or 0.0)
            found.append(rated_beside(whole, rest, placed, instead_of))
    return sorted(found, key=by_gain)


def _starts(effect: Effect, instead_of: Placed | None) -> list[Shape]:
    """Return the start values of an effect, also with the numbers of one whose place it would take.

    Of a memory that is short beside the motion, a grid holds no value near: LuGre friction is found
    from that of the Dahl friction that it contains.
    """
    if instead_of is None:
        return list(effect.grid)
    names = [q.name for q in instead_of.effect.shape]
    known = dict(zip(names, instead_of.shape, strict=True))
    also = (
        tuple(known.get(q.name, value) for q, value in zip(effect.shape, shape, strict=True))
        for shape in effect.grid
    )
    return list(dict.fromkeys([*effect.grid, *also]))


def _begins(effect: Effect, shapes: Sequence[Shape]) -> list[Shape]:
    """Return the shapes from which an effect is fitted, of its start values, best first.

    A grid that does not resolve each of several numbers may miss a narrow valley that ties them
    together, as gap and current of a magnet: it is found from one of its sides only. So the second
    begin is the next best one that differs in each number.
    """
    best = shapes[0]
    if len(best) < 2 or len(effect.grid) >= SearchOptions.resolved ** len(best):
        return [best]
    apart = (s for s in shapes if all(a != b for a, b in zip(s, best, strict=True)))
    return [best, *islice(apart, 1)]


def rated_beside(whole: Beside, rest: Beside, placed: Placed, instead_of: Placed | None) -> Rated:
    """Return the gain of an effect beside `rest` over the model of `whole`."""
    training, more = rest.training, numbers_of(placed)
    changes = training.effect_changes(rest.at, placed)
    own = training.effect_columns(rest.at, changes)
    columns, groups = (
        [np.concatenate(pair) for pair in zip(old, new, strict=True)]
        for old, new in ((rest.own, own), (rest.groups, changes))
    )
    before = Fitted(training.judged(whole.at, whole.own, whole.groups), whole.own, whole.at.missing)
    after = Fitted(training.judged(rest.at, columns, groups, more), columns, rest.at.missing)
    gain = gain_between(before, after, len(rest.own[0]), len(placed.amplitudes), training.blocks)
    found = before.judged.coefficients(), after.judged.coefficients()
    force = _force_share(whole, rest, placed, found)
    return Rated(placed, gain, force, instead_of)


@dataclass(frozen=True)
class Fitted:
    """A model's Gram matrices, and of each record its columns (C, rows, n) and missing force
    (rows, n)."""

    judged: Columns
    columns: list[Array]
    missing: list[Array]


def gain_between(before: Fitted, after: Fitted, base: int, amplitudes: int, blocks: Blocks) -> Gain:
    """Return the gain of one model over another; columns of `after`: `base` own ones of the model,
    so many amplitudes, and shapes."""
    left = [missing_after(m.judged.coefficients(), m.columns, m.missing) for m in (before, after)]
    size = block_sums(blocks, [one - other for one, other in zip(*left, strict=True)])
    return gain_of(before.judged, after.judged, size, base, amplitudes, blocks.record)


def _force_share(
    whole: Beside, rest: Beside, placed: Placed, coefficients: tuple[Array, Array]
) -> float:
    """Return by how much an effect lowers the RMS missing force, over the acting force.

    It is without weights, and the largest of all DOF. `coefficients` are those of both models,
    fitted with weights.
    """
    one, other = whole.relative, rest.relative
    changes = other.training.effect_changes(other.at, placed)
    more = other.training.effect_columns(other.at, changes)
    columns = [np.concatenate(pair) for pair in zip(other.own, more, strict=True)]
    before = missing_after(coefficients[0], one.own, one.at.missing)
    after = missing_after(coefficients[1], columns, other.at.missing)
    sizes = [
        np.sqrt(np.sum([np.sum(x * x, axis=0) for x in values], axis=0))
        for values in (before, after)
    ]
    forces = np.maximum(acting_force(one.at), TINY)
    return float(np.max((sizes[0] - sizes[1]) / forces))


def missing_after(
    coefficients: Array, columns: Sequence[Array], missing: Sequence[Array]
) -> list[Array]:
    """Return what columns leave of the missing force of each record."""
    return [m - np.tensordot(coefficients, c, 1) for c, m in zip(columns, missing, strict=True)]


def by_gain(rated: Rated) -> float:
    """Sort key: what gains most comes first."""
    return -float(rated.gain.raw.mean())


def is_free(placed: Placed) -> bool:
    """Return whether an effect is a free form."""
    return placed.effect.effect_class == "unknown"
