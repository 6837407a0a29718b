"""Test that weights make a residual white, without delay."""

from __future__ import annotations

import numpy as np
from scipy.signal import lfilter, welch

from levid.identification.trace.force_regression.residual_whitening import whitening_of

ROWS, ROW_S, LIMIT_HZ = 20_000, 0.005, 50.0


def coloured(seed: int) -> np.ndarray:
    white = np.random.default_rng(seed).normal(size=(ROWS, 2))
    return np.stack(
        [lfilter([1.0], [1.0, -0.9], white[:, 0]), 5.0 * lfilter([1.0, 0.8], [1.0], white[:, 1])],
        axis=1,
    )


def test_residual_becomes_white_with_one_per_independent_row():
    white = whitening_of([coloured(1)], [ROW_S], LIMIT_HZ)
    # Another realisation than the one that gave the weights.
    found = white.apply(coloured(2), ROW_S)
    freq_hz, density = welch(found, 1 / ROW_S, nperseg=200, axis=0)
    inside = density[(freq_hz > 2.0) & (freq_hz < 48.0)]
    # 46 lines, each of 200 averages: a scatter of 7 %, and as much by the weights.
    assert np.all(np.abs(inside / inside.mean(axis=0) - 1.0) < 0.35)
    # Half of the frequencies are below the limit; those above pass with the limit's weight.
    power = density[freq_hz <= LIMIT_HZ].sum(axis=0) * freq_hz[1]
    independent = 2.0 * ROWS * ROW_S * LIMIT_HZ
    # Three lines of seven half-overlapping segments have some 18 degrees of freedom; the mean of
    # an inverse spectrum is 18 / 16 of that of the true one.
    np.testing.assert_allclose(power * ROWS / independent, 18 / 16, rtol=0.1)


def test_signals_are_not_delayed():
    white = whitening_of([coloured(1)], [ROW_S], LIMIT_HZ)
    pulse = np.zeros((401, 2))
    pulse[200] = 1.0
    found = white.apply(pulse, ROW_S)
    np.testing.assert_allclose(found, found[::-1], atol=1e-6 * np.abs(found).max())
