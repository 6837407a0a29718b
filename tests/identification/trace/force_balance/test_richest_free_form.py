"""Test the richest free form: with the force of the inputs it would make every equation true."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from levid.identification.rounding import basis_of
from levid.identification.trace.force_balance.richest_free_form import (
    _laws_of_commands,
    _without_input,
)

RNG = np.random.default_rng(5)
COMMAND = RNG.uniform(-1.0, 1.0, (400, 1))


def given(columns: np.ndarray, force: np.ndarray) -> float:
    """Return the share of a squared force that columns give."""
    Q = basis_of(columns)
    return float(np.sum((Q.T @ force) ** 2) / np.sum(force**2))


def test_a_form_beside_a_cubic_law_of_the_command_does_not_give_the_command() -> None:
    form, law = np.hstack([COMMAND**2, 4.0 * COMMAND**3 - 3.0 * COMMAND]), COMMAND**3
    assert given(np.hstack([form, law]), COMMAND) == pytest.approx(1.0)
    left = _without_input(form, law, COMMAND)
    both = np.hstack([left, law])
    assert given(both, COMMAND) == pytest.approx(given(law, COMMAND), abs=1e-9)
    assert given(both, COMMAND**2) > 0.99


def test_a_form_that_does_not_give_the_command_is_kept() -> None:
    form, none = np.hstack([COMMAND**2, 4.0 * COMMAND**3 - 3.0 * COMMAND]), np.zeros((400, 0))
    assert _without_input(form, none, COMMAND) is form
    assert _without_input(form, none, np.zeros((400, 1))) is form


def test_a_form_does_not_give_a_command_of_three_levels() -> None:
    """A cube of it is the command itself."""
    command, none = np.sign(np.round(2.0 * COMMAND)), np.zeros((400, 0))
    left = _without_input(np.hstack([command**2, command**3]), none, command)
    assert given(left, command) < 0.02


def test_a_law_of_a_command_counts_in_records_that_leave_it_at_zero() -> None:
    """Axes that are excited one at a time: each record would have columns of its own."""

    def record(rows: int, *sizes: float) -> Any:
        changes = iter([np.full((1, 3, rows, 2), size) for size in sizes])
        return SimpleNamespace(kept=[np.zeros((rows, 2))], group_changes=lambda *_: next(changes))

    placed = [SimpleNamespace(effect=None, shape=()) for _ in range(3)]
    point: Any = SimpleNamespace(model=None, placed=placed)
    one, other = _laws_of_commands([record(4, 1.0, 0.0, 0.0), record(6, 0.0, 2.0, 0.0)], point)
    assert one.shape == (2, 4, 2)
    assert other.shape == (2, 6, 2)
    np.testing.assert_array_equal(one[:, 0, 0], [1.0, 0.0])
    np.testing.assert_array_equal(other[:, 0, 0], [0.0, 2.0])
