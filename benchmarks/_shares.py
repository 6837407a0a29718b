"""The ratio of two shares that were counted, and how sure it is."""

from __future__ import annotations

from math import exp, sqrt


def ratio_95(some: int, of: int, others: int, of_others: int) -> tuple[float, float]:
    """Return the ends of the 95 % interval of (some / of) / (others / of_others).

    By Katz's log method, with half a count added to each: a share of nothing has a bound too.
    """
    a, b = some + 0.5, others + 0.5
    ratio, spread = (a / of) / (b / of_others), exp(1.96 * sqrt(1 / a + 1 / b))
    return ratio / spread, ratio * spread
