"""What a record's start and its constant forces add to its errors, and what is told of them."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from numpy.typing import NDArray

from levid.identification.greybox.discretisation import Motion, taylor_scale
from levid.identification.greybox.filter_kernels import errors_and_unknowns, innovations_fixed
from levid.identification.greybox.noise_model import Noise, kalman_filter
from levid.identification.greybox.prediction_errors import predict_along

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
def test_columns_are_those_of_one_filter_each(force_psd: float, stiffness: float) -> None:
    # From a filter that forgets within seconds, and columns that never stand still, to one that
    # forgets in a hundred rows.
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
        alone = np.empty((rows, 2))
        seen = y if c == 0 else np.zeros((rows, 2))
        innovations_fixed(at.flow, kalman.gain[0], forcing, seen, start, alone)
        # What stands still to 1e-14 over 64 rows is that near to its end, times its memory.
        assert np.abs(out[:, :, c] - alone).max() < 1e-11 * np.abs(alone).max()


@pytest.mark.parametrize("blind", [0, 5, 130, 400])
def test_a_start_that_is_forgotten_when_errors_begin_takes_no_share_of_the_force(
    blind: int,
) -> None:
    rows, force_n = 5000, 20.0
    one = np.eye(1)
    at = replace(motion_of(2 * one, 12 * one, 800 * one, 1e-3, rows), blind=blind)
    noise = SENSOR_SD * np.random.default_rng(0).normal(size=(rows, 1))
    kalman = kalman_filter(at, Noise.independent(np.array([1e-2]), np.array([SENSOR_SD**2])))
    found = predict_along(at, SimpleNamespace(name="held", y=force_n / 800 + noise), kalman)  # type: ignore[arg-type]
    # What the filter takes for force noise, 0.1 N a root of Hz, over five seconds, three times.
    assert found.offset[0] == pytest.approx(force_n, abs=0.15)
    forgotten = blind > 5
    assert np.all(found.start == 0.0) == forgotten
    assert np.all(found.unknowns[:, :, 1:] == 0.0) == forgotten
