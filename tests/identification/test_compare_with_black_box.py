"""Test when a fitted model explains as much as the black-box model of the same records."""

from __future__ import annotations

from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from levid.identification.compare_with_black_box import BesideBlackBox, compare_with_black_box
from levid.identification.subspace.fit_percent import larger_by_chance
from levid.identification.subspace.held_out_simulation import HoldOut

ROWS = 800
RNG = np.random.default_rng(4)
Y = np.sin(0.05 * np.arange(ROWS))[:, None] * [1.0, 2.0]
NOISE = RNG.normal(size=(ROWS, 2))


@dataclass
class Checked:
    """What is read of a validation: errors of the fitted model, in units of the outputs."""

    errors: np.ndarray
    record: str = "r"
    metric: str = "free_run"
    one_step_percent: np.ndarray = field(default_factory=lambda: np.array([3.0, 3.0]))

    @property
    def time_s(self) -> np.ndarray:
        return np.arange(len(self.errors)) * 0.01

    @property
    def measured(self) -> np.ndarray:
        return Y[-len(self.errors) :]

    @property
    def simulated(self) -> np.ndarray:
        return self.measured - self.errors

    @property
    def error_percent(self) -> np.ndarray:
        return 100.0 * self.errors.std(axis=0) / self.measured.std(axis=0)

    @property
    def fit_percent(self) -> np.ndarray:
        return 100.0 - self.error_percent


def compared(ours: Checked, theirs: np.ndarray, *, stable: bool = True) -> BesideBlackBox | None:
    fit = np.zeros(2)
    simulated = Y - theirs if stable else np.full_like(Y, np.nan)
    held = HoldOut("r", np.arange(ROWS) * 0.01, Y, simulated, fit, Y - theirs, fit)
    grey, point = SimpleNamespace(validations=[ours]), SimpleNamespace(holdout=[held])
    point.stable = stable
    return compare_with_black_box(cast("Any", grey), [cast("Any", point)])


@pytest.mark.parametrize(("ratio", "as_good"), [(1.0, True), (1.05, True), (1.3, False)])
def test_errors_up_to_a_tenth_larger_are_alike(ratio: float, as_good: bool) -> None:
    found = compared(Checked(0.01 * ratio * NOISE), 0.01 * NOISE)
    assert found is not None
    assert (found.as_good, found.simulated) == (as_good, True)
    assert found.fitted_percent == pytest.approx(ratio * found.black_box_percent)


def test_the_worst_output_is_named_and_decides() -> None:
    found = compared(Checked(0.01 * NOISE * [1.0, 3.0]), 0.01 * NOISE)
    assert found is not None
    assert (found.output, found.as_good) == (1, False)


def test_a_difference_by_chance_counts_as_none() -> None:
    """A large error in one of eight blocks is 40 % of the mean, and no more than chance."""
    errors = 0.01 * NOISE
    errors[:100] *= 2.0
    found = compared(Checked(errors), 0.01 * NOISE[::-1])
    assert found is not None
    assert found.fitted_percent > 1.1 * found.black_box_percent
    assert found.as_good


def test_an_unstable_black_box_model_loses_against_one_that_simulates() -> None:
    found = compared(Checked(0.2 * Y), 0.001 * NOISE, stable=False)
    assert found is not None
    assert (found.simulated, found.stable, found.as_good) == (False, False, True)
    poor = compared(Checked(0.6 * Y), 0.001 * NOISE, stable=False)
    assert poor is not None
    assert not poor.as_good


def test_predictions_are_compared_with_predictions() -> None:
    ours = Checked(0.5 * Y, metric="prediction")
    found = compared(ours, 0.03 * Y)
    assert found is not None
    assert (found.simulated, found.as_good, found.fitted_percent) == (False, True, 3.0)


def test_there_is_no_comparison_without_a_common_record_or_motion() -> None:
    assert compared(Checked(0.01 * NOISE, record="other"), 0.01 * NOISE) is None
    assert compared(Checked(0.01 * NOISE[:4]), 0.01 * NOISE) is None  # too few rows for blocks


def test_errors_of_equal_size_differ_by_chance() -> None:
    assert larger_by_chance(NOISE[:, 0], NOISE[:, 1])
    assert larger_by_chance(0.5 * NOISE[:, 0], NOISE[:, 1])
    assert not larger_by_chance(2.0 * NOISE[:, 0], NOISE[:, 1])
