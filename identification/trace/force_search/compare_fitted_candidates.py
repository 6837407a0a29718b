"""Compare candidates where the fit of the whole model with each of them ends."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ....model.effects.actuator_chain import orders, same_law
from ....model.effects.base import Effect, Placed
from ...rounding import TINY
from ..force_balance.force_record import ForceModel
from ..force_balance.free_numbers import amplitudes_of, at_limits, numbers_of
from ..force_regression.candidate_fit import Beside, taken_at, told_share
from ..force_regression.gauss_newton_fit import fit_numbers
from ..force_regression.held_out_gain import Blocks, Columns, block_sums, bounded, error_of_mean
from ..force_regression.training_records import Training, missing_share
from ..search_options import SearchOptions
from .rated_candidate import Rated, confirmed, missing_after

Array = NDArray[np.float64]


def fitted_rivals(
    beside: ForceModel,
    first: Rated,
    ranking: Sequence[Rated],
    training: Training,
    options: SearchOptions,
    table: Sequence[Effect],
) -> list[tuple[Rated, ForceModel]]:
    """Return the confirmed candidates with the fitted model of each, the one to take first.

    `beside` is the model without them. `table` has all laws: some may act before or behind a lag,
    and the fits take the better order. Gains are foretold by a line, and a large effect moves the
    model's other numbers: so candidates are compared where the fit with each of them ends. One that
    is as good in its textbook form has a number less. What is
    not surely worse than the best is not told apart from it, nor is what equals it in a linear
    plant, where other effects are found at its inputs only. Of these the one with the fewest
    numbers comes first, and has the others as its alternatives, but for richer laws at its place: a
    richer law contains most simpler ones. Then come the others, best first.
    """
    rivals = [r for r in ranking if r.instead_of is first.instead_of and confirmed(r, options)]
    fitted = list[_Fitted]()
    for rated in rivals:  # best first: most others soon prove to stay behind
        least = min((f.cost for f in fitted), default=0.0)
        textbook = rated.placed.as_textbook()
        plain = None if textbook is None else _plain(beside, textbook, table, training, least)
        point = _in_best_order(beside, rated, table, training, least, plain)
        noise = training.noise(beside)
        own = _Fitted.at(point, rated, training, noise, options)
        if plain is None and (textbook := own.rated.placed.as_textbook()) is not None:
            # Its first numbers were beyond what a textbook law can have; the fitted ones are not.
            plain = _plain(beside, textbook, table, training, least)
        if plain is not None:
            held = _Fitted.at(plain, rated, training, noise, options)
            own = replace(own, textbook=not _worse(held, own, training.blocks, options))
        fitted.append(own)
    fitted.sort(key=lambda f: float(f.errors.sum()))
    alike = [f for f in fitted if not _worse(f, fitted[0], training.blocks, options)]
    there = {f.rated.placed.effect.key for f in alike}
    alike.sort(
        key=lambda f: (
            f.numbers,
            not there.isdisjoint(f.rated.placed.effect.contains),
            f.rated.numbers,
        )
    )
    inputs = set(training.records[0].signals.places.actuators)
    if all(inputs.issuperset(p.effect.where) for p in beside.placed):
        # Behind the laws of its inputs the plant is linear. The noise of the readings makes one of
        # the two fit better, whichever is true.
        same = {key for f in alike if _acts_last(f) for key in f.rated.placed.effect.same_if_linear}
        known = [id(f) for f in alike]
        alike += [f for f in fitted if f.rated.placed.effect.key in same and id(f) not in known]
    # A candidate that takes the place of an inertia, or is no law in the form that it needs, does
    # not explain what another one explains as well.
    alike = [f for f in alike if _has_inertia(f.point, beside, options)] or alike
    alike = [f for f in alike if f.is_law] or alike
    alike = [f for f in alike if not _as_linear(f, alike, training, options)]
    support = _support([f for f in fitted if f.is_law] or fitted, ranking, options)
    containing = [f.rated for f in alike[1:] if _richer(f, alike[0], inputs)]
    named = [replace(f.rated, support=support(f.rated)) for f in alike]
    named[0] = replace(named[0], support=support(alike[0].rated, *containing))
    contenders = tuple(r.placed.effect for r in ranking)
    others = tuple(
        r
        for r, f in zip(named[1:], alike[1:], strict=True)
        if not _richer(f, alike[0], inputs)
        and not f.rated.as_simpler
        and not any(_contains(f, other) for other in alike)
    )
    best = replace(named[0], alternatives=others, contenders=contenders)
    rest = [f for f in fitted if f is not alike[0]]
    told = [replace(f.rated, support=support(f.rated), contenders=contenders) for f in rest]
    return [(best, alike[0].point), *zip(told, (f.point for f in rest), strict=True)]


def _has_inertia(point: ForceModel, beside: ForceModel, options: SearchOptions) -> bool:
    """Return whether a fitted model still has inertia where the model `beside` it has some.

    The inertia in each direction of motion must be more than the relative error of a right law.
    """
    own, other = (np.asarray(p.model.at().M) for p in (point, beside))
    size = np.sqrt(np.abs(np.diag(other)))
    if not np.all(size > 0.0):
        return True
    one, before = (np.linalg.eigvalsh(0.5 * (M + M.T) / np.outer(size, size)) for M in (own, other))
    return bool(before[0] <= 0.0 or one[0] > options.alike * before[0])


def _as_linear(
    one: _Fitted, others: Sequence[_Fitted], training: Training, options: SearchOptions
) -> bool:
    """Return whether the force of a candidate is that of a linear law at its place, in these
    records: a dead zone that is wider than the commands is a gain."""
    own = one.last
    linear = [
        f.point for f in others if f.last.effect.linear and f.last.effect.where == own.effect.where
    ]
    if own.effect.linear:
        return False
    told = told_share(own.effect, options)
    return any(
        taken_at(Beside.of(p, training), own.effect, own.shape, told) is None for p in linear
    )


def _acts_last(one: _Fitted) -> bool:
    """Return whether no law of its input acts behind a candidate."""
    where = one.rated.placed.effect.where
    return not any(p.effect.before_lag and p.effect.where == where for p in one.point.placed)


def _richer(one: _Fitted, other: _Fitted, inputs: set[str]) -> bool:
    """Return whether one contains the other, by what it is or as it has more numbers at its place.

    Laws of an input do so only within their class: of a filter of second order, far above what the
    records have, the delay alone is seen, but a delay is no simpler case of it. Nor is a line with
    one of its two amplitudes near zero, by its phase, simpler than another line.
    """
    own, simpler = one.rated.placed.effect, other.rated.placed.effect
    nested = own.effect_class == simpler.effect_class or not inputs.issuperset(own.where)
    more = one.numbers > other.numbers and one.rated.numbers > other.rated.numbers
    return _contains(one, other) or (own.where == simpler.where and nested and more)


def _contains(one: _Fitted, other: _Fitted) -> bool:
    own, simpler = one.rated.placed.effect, other.rated.placed.effect
    return own.where == simpler.where and simpler.key in own.contains


@dataclass(frozen=True)
class _Fitted:
    """A candidate where the fit of the whole model with it ends.

    errors (B,): squared error of each block by the fit of all others, with the candidate's shape
    held; by_force: the same, before what follows. left: what remains of the weighed missing force
    of each record (rows, n). Errors, cost and what is left are relative to what the noise of the
    outputs is in it, as errors of the outputs would be: an equation of motion holds times any
    factor and after any filter, so that an actuator's lag may take the place of the mass. share
    (n,): what the squares are multiplied by for that. textbook: whether it is as good if it is held
    to its textbook form.
    """

    rated: Rated
    point: ForceModel
    cost: float
    errors: Array
    left: tuple[Array, ...]
    by_force: Array
    share: Array
    textbook: bool = False

    @property
    def is_law(self) -> bool:
        """Whether it is as textbooks have it, or they have no other form of it; where its range
        ends another law begins."""
        placed = self.last
        pairs = zip(placed.effect.shape, placed.shape, strict=True)
        if any(q.another_below and value <= q.low for q, value in pairs):
            return False
        return self.textbook or placed.as_textbook() is None

    @property
    def last(self) -> Placed:
        """The candidate with the numbers of the fit."""
        own = self.rated.placed.effect
        return next(p for p in self.point.placed if same_law(p.effect, own))

    @property
    def numbers(self) -> int:
        """Numbers of the candidate, without what the blocks do not ask for.

        Where a weight hangs in the zero of the angle, its law has one amplitude; a lag that is no
        other than in its textbook form has one number.
        """
        return self.rated.numbers - self.rated.idle - self.textbook

    @classmethod
    def at(
        cls,
        point: ForceModel,
        rated: Rated,
        training: Training,
        noise: Array,
        options: SearchOptions,
    ) -> _Fitted:
        """Return a candidate that is the last effect of a fitted model.

        noise (n,): power of the outputs' noise in the missing force of the model without it.
        """
        at = training.at(point)
        groups = training.group_columns(at)
        columns = training.columns(at, groups)
        judged = training.judged(at, columns, groups)
        last = replace(rated, placed=point.placed[-1])
        # A shape that the records hardly determine would move far by a fit without a block.
        kept = len(columns[0]) - numbers_of(last.placed) + amplitudes_of(last.placed)
        # A parameter that the fit left at a limit of its range is not free to go on.
        names, limited = point.parameters.names, {name for name, _, _ in at_limits(point)}
        ends = [i for i, name in enumerate(names) if name in limited]
        free = [i for i in range(kept) if i not in ends]
        held = judged.only(free)
        left = missing_after(held.coefficients(), [c[free] for c in columns], at.missing)
        last = replace(last, idle=_idle_amplitudes(held, last.placed, options))
        own = np.maximum(training.noise(point) * at.share**2, TINY)
        more = noise / own  # the missing force is already times the share
        by_dof = held.left_out_errors_by_dof()
        errors = (by_dof * more).sum(axis=1)
        cost = training.cost(point) * float(errors.sum() / max(by_dof.sum(), TINY))
        relative = tuple(x * np.sqrt(more) for x in left)
        return cls(last, point, cost, errors, relative, by_dof.sum(axis=1), more)


def _plain(
    beside: ForceModel, law: Placed, table: Sequence[Effect], training: Training, least: float
) -> ForceModel:
    """Fit the model with a candidate that is held to its textbook form, as `_in_best_order`."""
    placed = orders((*beside.placed, law), table, beside.model.lagging)
    fits = [fit_numbers(training, replace(beside, placed=order), least) for order in placed]
    return min(fits, key=training.cost)


def _in_best_order(
    beside: ForceModel,
    rated: Rated,
    table: Sequence[Effect],
    training: Training,
    least: float,
    plain: ForceModel | None,
) -> ForceModel:
    """Fit the model with a candidate; not to the end if it stays far above the least cost.

    Of several orders of an actuator's laws it has the one that fits best. From the fit of its
    textbook form, if it has one, it is fitted too: how much there is of it, and how it is, may be
    along one valley.
    """
    placed = orders((*beside.placed, rated.placed), table, beside.model.lagging)
    begins = [replace(beside, placed=order) for order in placed]
    if plain is not None:
        begins.append(plain.freed())
    return min((fit_numbers(training, begin, least) for begin in begins), key=training.cost)


def is_as_good(
    one: ForceModel,
    other: ForceModel,
    rest: ForceModel,
    rated: Rated,
    training: Training,
    options: SearchOptions,
) -> bool:
    """Return whether a fitted model is not worse than another one, each with its last effect beside
    those of the model `rest`. `rated`: the rating of the other one's last effect."""
    noise = training.noise(rest)
    mine, best = (_Fitted.at(p, rated, training, noise, options) for p in (one, other))
    return not _worse(mine, best, training.blocks, options)


def richer_matters(
    richer: ForceModel,
    simple: ForceModel,
    rated: Rated,
    training: Training,
    options: SearchOptions,
) -> bool:
    """Return whether a law takes what an effect must take beside a simpler one in its place.

    Each is the last effect of its fitted model. `rated`: the rating of the richer one. Of two laws
    with equally many numbers none is simpler, and what surely takes more is enough.
    """
    noise = training.noise(simple)
    one, other = (_Fitted.at(p, rated, training, noise, options) for p in (richer, simple))
    size = block_sums(training.blocks, [a - b for a, b in zip(one.left, other.left, strict=True)])
    gain = bounded(other.errors - one.errors, size)
    surely = gain.mean() > options.standard_errors * error_of_mean(gain, size)
    if numbers_of(richer.placed[-1]) == numbers_of(simple.placed[-1]):
        return bool(surely)
    share = float(gain.sum()) / max(float(other.errors.sum()), TINY)
    plain = training.plain
    less = missing_share(plain.at(simple)) - missing_share(plain.at(richer))
    return bool(surely and share > options.least_gain and less.max() > options.least_force)


def _idle_amplitudes(held: Columns, placed: Placed, options: SearchOptions) -> int:
    """Return how many amplitudes of an effect could be zero, each by itself, all but one at most.

    held: columns of the model, of which the last are the amplitudes.
    """
    if placed.plain:
        return 0
    with_all, count = held.left_out_errors(), len(held.prior) - 1
    first, idle = count - len(placed.amplitudes), 0
    for i, amplitude in enumerate(placed.amplitudes, start=first):
        take = np.eye(count + 1)
        take[i, -1] = amplitude
        back = Columns(take.T @ held.grams @ take, take.T @ held.power @ take, held.prior)
        less = back.only([k for k in range(count) if k != i])
        lost = less.left_out_errors() - with_all
        size = amplitude**2 * held.grams[..., i, i].sum(axis=1)
        idle += lost.mean() < options.standard_errors * error_of_mean(lost, size)
    return min(idle, len(placed.amplitudes) - 1)


def _worse(one: _Fitted, best: _Fitted, blocks: Blocks, options: SearchOptions) -> bool:
    """Return whether a fitted candidate is worse: surely, by the scatter of the difference, and by
    more than the equation of the best may be wrong by.

    It must be so both relative to the noise of the outputs and by force alone: a small difference
    of two masses is no more sure than these, but the same in all blocks. What leaves more force,
    and much more relative to the noise, as if another effect were missing, is worse if it does so
    in most blocks: the scatter of the difference may be that of a few which have most of it.
    """
    least = options.inexact * float(best.rated.gain.raw.mean())

    def surely(errors: tuple[Array, Array], left: list[Array]) -> bool:
        size = block_sums(blocks, left)
        difference = bounded(errors[0] - errors[1], size)
        chance = options.standard_errors * error_of_mean(difference, size)
        return bool(difference.mean() > max(chance, least))

    pairs = list(zip(one.left, best.left, strict=True))
    by_noise = surely((one.errors, best.errors), [a - b for a, b in pairs])
    forces = [a / np.sqrt(one.share) - b / np.sqrt(best.share) for a, b in pairs]
    if by_noise and surely((one.by_force, best.by_force), forces):
        return True
    ratio = np.log(np.maximum(one.errors, TINY) / np.maximum(best.errors, TINY))
    in_most = ratio.mean() > options.standard_errors * ratio.std(ddof=1) / np.sqrt(len(ratio))
    much = one.errors.sum() > options.much_left**2 * best.errors.sum()
    more = one.by_force.sum() > (1.0 + options.least_gain) * best.by_force.sum()
    return bool(in_most and much and more)


def _support(
    fitted: Sequence[_Fitted], ranking: Sequence[Rated], options: SearchOptions
) -> Callable[..., float]:
    """Return the function that gives the share of resamples of the blocks in which the class and
    place of a candidate, or of richer laws that contain it, gain most of all."""
    gains = np.array([r.gain.raw for r in ranking])
    errors = np.array([f.errors for f in fitted])
    rng = np.random.default_rng(0)
    picks = rng.integers(errors.shape[1], size=(options.resamples, errors.shape[1]))
    wins = np.argmin(errors[:, picks].mean(axis=2), axis=0)
    none = np.all(gains[:, picks].mean(axis=2) <= 0.0, axis=0)

    def kind(rated: Rated) -> tuple[str, tuple[str, ...]]:
        return rated.placed.effect.effect_class, rated.placed.effect.where

    kinds = [kind(f.rated) for f in fitted]

    def share(*rated: Rated) -> float:
        own = {kind(one) for one in rated}
        same = [i for i, other in enumerate(kinds) if other in own]
        return float(np.mean(np.isin(wins, same) & ~none))

    return share
