"""Compare the support of named effects with how often they are true: reliability, Brier, log score.

A statement is one name at its place, with its support: of an ambiguous effect each member is one.
Free forms name nothing, and a random vibration has no support; neither is a statement.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np

from levid.benchmarks.harness.benchmark_runner import Figure

EDGES = (0.0, 0.2, 0.4, 0.6, 0.8, 0.95, 1.0)
"""Of the bins of support in the reliability table; the last one is for what is nearly certain."""
_SURE = 0.005
"""Supports are shares of 200 resamples: none is told closer to 0 or 1 than one of them."""


@dataclass(frozen=True)
class Statement:
    """The support of a name, between 0 and 1, and whether it is true."""

    support: float
    true: bool


def statements(
    summary: Mapping[str, Any], is_true: Callable[[Mapping[str, Any]], bool]
) -> list[Statement]:
    """Return the statements of a trace's JSON; `is_true` judges one name with class and place."""
    members = [
        member
        for effect in summary["effects"]
        for member in (effect.get("alternatives") or [effect])
        if member["class"] != "unknown"
    ]
    known = ((m, m.get("support")) for m in members)
    return [Statement(float(s), is_true(m)) for m, s in known if s is not None and np.isfinite(s)]


def brier(told: Sequence[Statement]) -> float:
    """Return the mean squared difference of support and truth: 0 is perfect, 0.25 a toss."""
    return float(np.mean([(s.support - s.true) ** 2 for s in told]))


def log_score(told: Sequence[Statement]) -> float:
    """Return the mean negative log likelihood of the truth: 0 is perfect, 0.69 a toss."""
    p = np.clip([s.support for s in told], _SURE, 1.0 - _SURE)
    return float(-np.mean(np.where([s.true for s in told], np.log(p), np.log(1.0 - p))))


def reliability(told: Sequence[Statement]) -> list[tuple[float, float, int, float, float]]:
    """Return for each bin of support: edges, number, mean support, share of true statements."""
    support = np.array([s.support for s in told])
    true = np.array([s.true for s in told])
    rows = []
    for low, high in pairwise(EDGES):
        inside = (support >= low) & ((support < high) | (high == EDGES[-1]))
        count = int(inside.sum())
        if count:
            rows.append(
                (low, high, count, float(support[inside].mean()), float(true[inside].mean()))
            )
    return rows


def figures(told: Sequence[Statement]) -> Iterator[Figure]:
    """Yield both scores and the reliability table; nothing without statements."""
    if not told:
        return
    yield Figure("statements", len(told), "", "names with a support")
    yield Figure("brier", brier(told), "", "Brier score of the support (0.25: a toss)")
    yield Figure("log_score", log_score(told), "", "log score of the support (0.69: a toss)")
    for low, high, count, mean, share in reliability(told):
        label = f"true of {count} names with support {low:g} to {high:g}, mean {mean:.2g}"
        yield Figure(f"true_percent_{100 * low:.0f}_{100 * high:.0f}", 100.0 * share, "%", label)
