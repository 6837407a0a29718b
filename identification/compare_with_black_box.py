"""Compare the fitted model with the black-box model of the same records, on held-out rows.

A black-box model has as many numbers as it needs. A model with physical parameters that explains as
much says more about the plant, and holds at other rates, loads and positions.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .greybox.identify_greybox import GreyBox
from .greybox.validation import Validation
from .results import OpenLoopPoint
from .subspace.fit_percent import BLOCKS, larger_by_chance
from .subspace.held_out_simulation import HoldOut

Array = NDArray[np.float64]

_ALIKE = 1.1
"""Ratio of two RMS errors up to which they count as alike: 10 % are less than one decibel."""
_FIT_PERCENT = 50.0
"""Least fit of a simulation that is better than none, where the black-box model has none."""
_MOVES = 1e-3
"""Least deviation of an output in the compared rows, over that of all held-out rows."""


@dataclass(frozen=True)
class BesideBlackBox:
    """The errors of both models on the same held-out rows, for the output with the largest ratio.

    output: its index; record: its name. simulated: whether the errors are of simulations, else one
    step ahead. fitted_percent, black_box_percent: errors over the output, RMS without means.
    stable: whether the black-box model can simulate. as_good: whether the fitted model explains as
    much at every output of every record, up to chance and 10 %.
    """

    record: str
    output: int
    simulated: bool
    fitted_percent: float
    black_box_percent: float
    stable: bool
    as_good: bool


def compare_with_black_box(grey: GreyBox, points: Sequence[OpenLoopPoint]) -> BesideBlackBox | None:
    """Return the comparison; None without a record that both models have."""
    by_record = {v.record: v for v in grey.validations}
    worst: BesideBlackBox | None = None
    as_good = True
    for point in points:
        for held in point.holdout:
            if held.record not in by_record:
                continue
            for found in _of_record(by_record[held.record], held, point.stable):
                as_good &= found.as_good
                if worst is None or _ratio(found) > _ratio(worst):
                    worst = found
    if worst is None:
        return None
    return BesideBlackBox(
        worst.record,
        worst.output,
        worst.simulated,
        worst.fitted_percent,
        worst.black_box_percent,
        worst.stable,
        as_good,
    )


def _ratio(found: BesideBlackBox) -> float:
    return found.fitted_percent / max(found.black_box_percent, 1e-12)


def _of_record(v: Validation, held: HoldOut, stable: bool) -> Iterator[BesideBlackBox]:
    """Yield the comparison of each output that moves."""
    rows = min(len(v.time_s), len(held.time_s))
    measured = held.measured[-rows:]
    by_simulation = stable and v.metric == "free_run"
    black_box = held.simulated if by_simulation else held.predicted
    if black_box is None or rows < BLOCKS:
        return
    errors = measured - black_box[-rows:]
    whole = held.measured.std(axis=0)
    for i in range(measured.shape[1]):
        size = float(measured[:, i].std())
        if not size > _MOVES * whole[i] or not np.all(np.isfinite(errors[:, i])):
            continue
        theirs = 100.0 * float(errors[:, i].std()) / size
        ours = float(v.error_percent[i] if by_simulation else v.one_step_percent[i])
        good = bool(ours <= _ALIKE * theirs)
        if by_simulation and not good:
            good = larger_by_chance(v.measured[-rows:, i] - v.simulated[-rows:, i], errors[:, i])
        if not stable and v.metric == "free_run":
            good = good or bool(v.fit_percent[i] > _FIT_PERCENT)
        yield BesideBlackBox(v.record, i, by_simulation, ours, theirs, stable, good)
