"""The ratio of two shares that were counted in turns, and how sure it is."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from math import ceil, exp, inf, log, sqrt
from typing import NamedTuple

import numpy as np
from _table import Figure

MOST_RATIO = 1.5
"""What late shares may be, relative to those of an empty loop or of cyclictest."""
ENOUGH = 50
"""Of so many on each side the 95 % interval of a ratio of 1 ends below MOST_RATIO."""
_RESAMPLED = 4000


class Round(NamedTuple):
    """One turn of each: how many of how many, and the same of the others."""

    some: int
    of: int
    others: int
    of_others: int


@dataclass(frozen=True)
class Ratio:
    """(some / of) / (others / of_others) over all rounds, and the ends of its 95 % interval."""

    value: float
    low: float
    high: float

    @property
    def decided(self) -> bool:
        """Whether all of the interval lies on one side of MOST_RATIO."""
        return self.high <= MOST_RATIO or self.low > MOST_RATIO


def ratio_95(rounds: Sequence[Round]) -> Ratio:
    """Return the ratio with the wider of two intervals, half a count added to each side.

    Katz's log method knows how few were counted, but takes each for independent of the others;
    a bootstrap over the rounds knows that they come in clusters, as where the machine stalls.
    """
    a, of, b, of_others = np.sum(rounds, axis=0) + np.array([0.5, 0, 0.5, 0])
    ratio, spread = float(a / of / (b / of_others)), exp(1.96 * sqrt(1 / a + 1 / b))
    rng = np.random.default_rng(1)
    drawn = rng.integers(len(rounds), size=(_RESAMPLED, len(rounds)))
    some, n, others, n_others = np.array(rounds)[drawn].sum(axis=1).T
    low, high = np.quantile((some + 0.5) / n / ((others + 0.5) / n_others), (0.025, 0.975))
    return Ratio(ratio, min(ratio / spread, float(low)), max(ratio * spread, float(high)))


def again(rounds: Sequence[Round], least: int, most: int) -> bool:
    """Return whether another round is due: too few as yet, or ENOUGH not counted on each side."""
    some, _, others, _ = np.sum(rounds, axis=0) if rounds else (0, 0, 0, 0)
    return len(rounds) < least or (len(rounds) < most and min(some, others) < ENOUGH)


def ratio_figures(rounds: Sequence[Round], low: str, high: str, who: str) -> list[Figure]:
    """Return both ends of the interval under these keys, and whether it decides; say if not."""
    ratio = ratio_95(rounds)
    if not ratio.decided:
        some, of, others, of_others = np.sum(rounds, axis=0)
        print(
            f"{who}: undecided whether at most {MOST_RATIO:g} times: {some} of {of} late against "
            f"{others} of {of_others}; {_would_decide(ratio, len(rounds))}",
            file=sys.stderr,
        )
    return [
        Figure(low, ratio.low, "", f"{who}: ratio of the shares, lower 95 % bound"),
        Figure(high, ratio.high, "", f"{who}: ratio of the shares, upper 95 % bound"),
        Figure(f"{high}_decided", float(ratio.decided), "", f"{who}: all on one side of 1.5"),
    ]


def _would_decide(ratio: Ratio, rounds: int) -> str:
    """Return how many rounds would, for the width of an interval falls with their root."""
    away = abs(log(MOST_RATIO / ratio.value)) if ratio.value > 0 else inf
    more = (0.5 * log(ratio.high / ratio.low) / away) ** 2 if away > 0 else inf
    if more > 1000:
        return "it is too near to that for any number of rounds"
    return f"about {ceil(rounds * max(more, 1.0)) + 1} such rounds would decide if it stays there"
