"""Test prediction errors: columns of unknown constant forces and of the initial state."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from numpy.typing import NDArray

from levid.identification.greybox.prediction.discretisation import Motion, taylor_scale
from levid.identification.greybox.prediction.filter_kernels import (
    errors_and_unknowns,
    innovations_fixed,
)
from levid.identification.greybox.prediction.noise_model import Noise, kalman_filter
from levid.identification.greybox.prediction.prediction_errors import predict_along

Array = NDArray[np.float64]
SENSOR_SD = 2e-7


def motion_of(M: Array, D: Array, K: Array, Ts_s: float, rows: int) -> Motion:
    """Return a mass on a spring without any input."""
    mobility = np.linalg.inv(M)
    K, D = (mobility @ K)[None], (mobility @ D)[None]
    scale = taylor_scale(K, D, Ts_s)
    order, n = len(scale) - 1, len(M)
    return Motion(
        K, D, mobility[None], mobility[None], np.zeros((1, order, n)), scale,
        np.zeros((rows, order, n)), Ts_s, 0,
    )  # fmt: skip


@pytest.mark.parametrize("force_psd", [1e-14, 1e-8, 1e-2, 1e2])
@pytest.mark.parametrize("stiffness", [1.0, 0.0, -1.0])
def test_each_column_equals_a_filter_run_alone(force_psd: float, stiffness: float) -> None:
    # From a filter with a memory of seconds, whose columns never settle, to one with a memory of
    # a hundred rows.
    rng, rows = np.random.default_rng(1), 6000
    M = np.array([[2.0, 0.1], [0.1, 1.5]])
    at = motion_of(M, np.diag([12.0, 5.0]), stiffness * np.diag([800.0, 200.0]), 1e-3, rows)
    kalman = kalman_filter(at, Noise.independent(np.full(2, force_psd), np.full(2, SENSOR_SD**2)))
    y = SENSOR_SD * rng.normal(size=(rows, 2)).cumsum(axis=0)
    out = np.full((rows, 2, 7), np.nan)
    errors_and_unknowns(at.flow, kalman.gain[0], at.forcing[:rows], at.steady, y, out)
    for c in range(7):
        forcing, start = np.zeros((rows, 4)), np.zeros(4)
        if 1 <= c < 3:
            forcing += at.steady[:, c - 1]
        elif c >= 3:
            start[c - 3] = 1.0
        expected = np.empty((rows, 2))
        y_or_zero = y if c == 0 else np.zeros((rows, 2))
        innovations_fixed(at.flow, kalman.gain[0], forcing, y_or_zero, start, expected)
        # A column that changes by 1e-14 over 64 rows is that near to its limit, times the memory.
        assert np.abs(out[:, :, c] - expected).max() < 1e-11 * np.abs(expected).max()


@pytest.mark.parametrize("blind", [0, 5, 130, 400])
def test_forgotten_initial_state_does_not_affect_the_force_estimate(
    blind: int,
) -> None:
    rows, force_n = 5000, 20.0
    one = np.eye(1)
    at = replace(motion_of(2 * one, 12 * one, 800 * one, 1e-3, rows), blind=blind)
    noise = SENSOR_SD * np.random.default_rng(0).normal(size=(rows, 1))
    kalman = kalman_filter(at, Noise.independent(np.array([1e-2]), np.array([SENSOR_SD**2])))
    found = predict_along(at, SimpleNamespace(name="held", y=force_n / 800 + noise), kalman)  # type: ignore[arg-type]
    # Force noise of 0.1 N/sqrt(Hz) over five seconds, three standard deviations.
    assert found.offset[0] == pytest.approx(force_n, abs=0.15)
    forgotten = blind > 5
    assert np.all(found.start == 0.0) == forgotten
    assert np.all(found.unknowns[:, :, 1:] == 0.0) == forgotten
