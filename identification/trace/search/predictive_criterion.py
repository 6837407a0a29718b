"""Judge an effect by data that did not fit it: the one rule by which it is added or refused.

An effect is taken if

1. blocks of time, each predicted by the others, agree with it beyond chance,
2. held-out records lower their errors by it, where it should do more in them than chance does, and
   do not surely raise them elsewhere,
3. it takes enough to matter: of the free-run error of held-out records, or of the errors one step
   ahead where these records do not show it, and at least the square of that of both.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from ..linearised.linearisation_point import WorkingPoint
from ..search_options import SearchOptions
from .gauss_newton import gather
from .regression import ColumnEvidence, foretold, foretold_between, solve
from .tested_candidate import FRICTION, Agreement, HeldError, Records, Tried, is_internal

Array = NDArray[np.float64]

HALF = 0.5
"""Of what an effect must take, as much is enough at a first guess of its shape to fit that."""


@dataclass(frozen=True)
class Criterion:
    """What an effect must take, in squared errors, and how surely.

    `excess` is what there is, `explained` what others took of it before. visible: where the free
    simulation of the held-out records has nothing left to explain, what an effect of the platform
    that they know must take; 0 otherwise. rubbed: what friction on each DOF takes.
    """

    options: SearchOptions
    excess: float
    explained: float
    visible: float = 0.0
    rubbed: Mapping[str, float] = field(default_factory=dict)

    def takes(self, tried: Tried) -> bool:
        """Return whether a tested candidate is taken."""
        return confirmed(tried.agreement, self.options) and tried.gain > self.worth(tried)

    def may_take(self, tried: Tried) -> bool:
        """Return whether a candidate at a first guess of its shape is worth a fit of that."""
        least = max(share_of(tried, self.options) ** 2 * self.excess, self._least(tried))
        return tried.gain > (HALF if tried.shape else 1.0) * least

    def worth(self, tried: Tried) -> float:
        """Return the squared errors one step ahead that a candidate must take.

        Where held-out records show it, their free-run error tells whether it matters (`helps`):
        what moves the platform slowly may hide among other errors of a step, of which it must take
        the square of that share.
        """
        shown = tried.agreement.asked and not is_internal(tried.effect)
        share = share_of(tried, self.options)
        if shown and not self.visible:
            share *= share
        return max(share * self.excess, self.visible if shown else 0.0, self._least(tried))

    def _least(self, tried: Tried) -> float:
        """Return what is no chance, and more than the equations of others leave."""
        effect, options = tried.effect, self.options
        worth = max(options.inexact * self.explained, options.least_squares)
        if effect.effect_class != FRICTION:
            rubbed = max((self.rubbed.get(w, 0.0) for w in effect.where), default=0.0)
            worth = max(worth, options.another_law * rubbed)
        return worth


def share_of(tried: Tried, options: SearchOptions) -> float:
    """Return the share of what noise does not explain that an effect must take to matter."""
    is_free = tried.effect.effect_class == "unknown"
    return options.least_free_gain if is_free else options.least_gain


def confirmed(agreement: Agreement, options: SearchOptions) -> bool:
    """Return whether data that did not fit an effect agree with it.

    Held-out records that agree by more than half of what is expected have smaller errors with it.
    The errors of those that are not asked must not be surely larger.
    """
    lowers_by = agreement.held - 0.5 * agreement.expected
    least = 0.0 if agreement.asked else -options.standard_errors
    return agreement.between > options.agreement and lowers_by > least


def certainty(agreement: Agreement) -> float:
    """Return the statistic that decided, in standard deviations of chance."""
    return agreement.held if agreement.asked else agreement.between


def tested(
    point: WorkingPoint, tried: Sequence[Tried], records: Records, options: SearchOptions
) -> list[Tried]:
    """Return candidates with what training and held-out records say of them, at their shapes."""
    candidates = [(t.effect, t.shape) for t in tried]
    train = gather(point, records.train(point, candidates))
    held = gather(point, records.held(point, candidates))
    own = len(train.size) - 1
    return [
        replace(t, agreement=_agreement(train.joined(i), held.joined(i), own, options))
        for i, t in enumerate(tried)
    ]


def helps(
    tried: Tried, before: HeldError, after: HeldError, explained: bool, criterion: Criterion
) -> bool:
    """Return whether held-out records confirm an effect, by their free-run errors.

    Where they should show it and are not `explained` without it, it must take its share of what
    noise does not explain; elsewhere they must not surely rise. A mass on a spring follows a line
    that shakes the platform one step ahead, and foretells nothing of it. Of what takes its share
    one step ahead the square is enough: a larger effect that is still missing may hide it.
    """
    asked = tried.agreement.asked and not is_internal(tried.effect) and not explained
    share = share_of(tried, criterion.options)
    if tried.gain > share * criterion.excess:
        share *= share
    falls = before.squares - after.squares > share * max(before.squares - before.floor, 0.0)
    return not is_worse(after, before, criterion.options) and (falls or not asked)


def is_worse(one: HeldError, other: HeldError, options: SearchOptions) -> bool:
    """Return whether a free-run error of the held-out records is surely above another one.

    Surely is by the standard errors of the options, of the sum over blocks of time. One block alone
    tells nothing, unless the simulation diverges.
    """
    if not np.isfinite(one.squares):
        return True
    rise = one.blocks - other.blocks
    if len(rise) < 2:
        return False
    return bool(rise.sum() > options.standard_errors * rise.std(ddof=1) * np.sqrt(len(rise)))


def _agreement(
    train: ColumnEvidence, held: ColumnEvidence, own: int, options: SearchOptions
) -> Agreement:
    """Return the agreement with the columns behind the first `own`, which are there already."""
    columns = list(range(len(train.size) - 1))
    base, group = columns[:own], columns[own:]
    coefficients = solve(train.whole, columns) / train.size[:-1] * held.size[:-1]
    between = foretold_between(train, base, group)
    elsewhere = foretold(held, base, group, coefficients)
    asked = elsewhere.expected > options.agreement
    return Agreement(between.statistic, elsewhere.expected, elsewhere.statistic, asked)
