"""Test the steps of a fixed-point iteration on maps with known fixed points."""

from __future__ import annotations

import numpy as np
import pytest

from levid.identification.trace.residual.fixed_point_iteration import (
    AndersonMixing,
    DampedSteps,
    settles,
)


def iterated(steps: AndersonMixing | DampedSteps, A: np.ndarray, b: np.ndarray, n: int) -> float:
    """Return the residual of x = A x + b after n steps from 0."""
    x = np.zeros(len(b))
    for _ in range(n):
        image = A @ x + b
        (x,) = steps.next((x,), (image,), image - x)
    return float(np.linalg.norm(A @ x + b - x))


def test_anderson_mixing_solves_a_linear_map_in_as_many_steps_as_it_has_unknowns() -> None:
    """Also one that grows without it: the largest eigenvalue here is about 7."""
    rng = np.random.default_rng(1)
    A, b = 2.0 * rng.normal(size=(12, 12)), rng.normal(size=12)
    assert np.abs(np.linalg.eigvals(A)).max() > 3.0
    assert iterated(AndersonMixing(20), A, b, 14) < 1e-6
    assert iterated(DampedSteps(), A, b, 14) > 1e3


@pytest.mark.parametrize("steps", [DampedSteps(), AndersonMixing(5)], ids=["damped", "anderson"])
def test_oscillation_is_damped(steps: AndersonMixing | DampedSteps) -> None:
    assert iterated(steps, np.array([[-1.5]]), np.array([1.0]), 40) < 1e-6


def test_steps_settle_in_time_if_the_last_ones_are_fast_enough() -> None:
    halved = tuple(0.5**k for k in range(7))
    assert settles(halved, 10, halved[-1] * 0.5**9.9)
    assert not settles(halved, 10, halved[-1] * 0.5**10.1)
    # Fast at first, they are slow now.
    assert not settles((1e6, *(0.99**k for k in range(6))), 10, 0.1)
    # A rate of 1e7 to the power of the steps left is no number.
    assert not settles(tuple(10.0 ** (7 * k) for k in range(7)), 55, 0.1)
    assert settles((1.0, 2.0), 1, 0.0), "two steps tell nothing"
