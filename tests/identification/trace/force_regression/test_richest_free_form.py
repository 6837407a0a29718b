"""Test the richest free form: with the force of the inputs it would make every equation true."""

from __future__ import annotations

import numpy as np
import pytest

from levid.identification.rounding import basis_of
from levid.identification.trace.force_regression.richest_free_form import _without_input

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
