"""Test moments of forces between samples: polynomial and band-limited interpolation."""

import numpy as np
import pytest
from numpy.polynomial import Polynomial

from levid.identification.trace.linearised.intersample_moments import (
    POINTS,
    force_moments,
    polynomial_weights,
)
from levid.identification.trace.records.effect_signals import rate

TS = 2e-3
ORDER = 5
INNER = slice(2, -4)
"""Rows whose six points all lie within the record."""


def exact_moments(force: Polynomial, rows: int) -> np.ndarray:
    """Integrate (Ts - s)^j / j! f(t_k + s) over 0 .. Ts by polynomial algebra alone."""
    result = np.empty((rows, ORDER))
    for k in range(rows):
        here = force(Polynomial([k * TS, 1.0]))
        rest = Polynomial([1.0])
        for j in range(ORDER):
            result[k, j] = (rest * here).integ()(TS)
            rest = rest * Polynomial([TS, -1.0]) / (j + 1)
    return result


def relative(found: np.ndarray, exact: np.ndarray) -> float:
    return float(np.max(np.abs(found - exact)[INNER] / np.abs(exact[INNER]).max(axis=0)))


@pytest.mark.parametrize("degree", range(POINTS))
def test_moments_of_polynomials_up_to_fifth_degree_are_exact(degree: int) -> None:
    rows = 20
    course = Polynomial(np.random.default_rng(degree).normal(size=degree + 1))
    force = course(Polynomial([-1.0, 2 / (rows * TS)]))  # of order one over the record
    found = force_moments(force(np.arange(rows) * TS)[:, None], TS, ORDER, "zoh")[:, :, 0]
    # Rounding: the inverse Vandermonde of six points magnifies 1e-16 by its condition, 2e3.
    assert relative(found, exact_moments(force, rows)) < 1e-11


def test_sixth_degree_is_beyond_six_points() -> None:
    # This shows that the test above is not exact for another reason.
    force = Polynomial([0, 0, 0, 0, 0, 0, 1.0])(Polynomial([-1.0, 2 / (20 * TS)]))
    found = force_moments(force(np.arange(20) * TS)[:, None], TS, ORDER, "zoh")[:, :, 0]
    assert relative(found, exact_moments(force, 20)) > 1e-9


def test_weights_of_a_constant_force_are_its_steady_moments() -> None:
    # A constant over the period has the moments Ts^(j+1) / (j+1)!.
    steady = TS ** np.arange(1, ORDER + 1) / np.cumprod(np.arange(1.0, ORDER + 1))
    np.testing.assert_allclose(polynomial_weights(TS, ORDER).sum(axis=1), steady, rtol=1e-11)


def test_polynomial_interpolation_of_a_sine_is_better_than_linear() -> None:
    omega, t = 2 * np.pi * 0.1 / TS, np.arange(400) * TS
    now, after = np.sin(omega * t), np.sin(omega * (t + TS))
    exact = (np.cos(omega * t) - np.cos(omega * (t + TS))) / omega
    smooth = force_moments(now[:, None], TS, 1, "zoh")[:, 0, 0]
    straight = 0.5 * TS * (now + after)
    size = np.abs(exact).max()
    # A straight line has an error of (omega Ts)^2 / 12 = 3.3 %. The polynomial's error is its next
    # difference, (omega Ts)^6 times 191 / 60480 for this stencil (Gauss coefficient): 2e-4.
    assert np.max(np.abs(straight - exact)[INNER]) / size == pytest.approx(0.033, rel=0.05)
    assert np.max(np.abs(smooth - exact)[INNER]) / size < 3e-4


def test_band_limited_force_is_interpolated_between_samples() -> None:
    omega, t = 2 * np.pi * 0.3 / TS, np.arange(2000) * TS  # too fast for a polynomial
    exact = (np.cos(omega * t) - np.cos(omega * (t + TS))) / omega
    found = force_moments(np.sin(omega * t)[:, None], TS, 3, "band_limited")[:, 0, 0]
    middle = slice(300, -300)  # away from the ends
    # Linear interpolation with eight points per period: (omega Ts / 8)^2 / 12 = 0.5 %.
    error = np.abs(found - exact)[middle].max() / np.abs(exact).max()
    assert error < 1.2 * (omega * TS / 8) ** 2 / 12


def test_derivative_of_samples_is_of_fourth_order() -> None:
    errors = []
    for Ts_s in (2e-3, 1e-3):
        t = np.arange(round(1 / Ts_s)) * Ts_s
        found = rate(np.sin(40 * t)[:, None], Ts_s)[:, 0]
        errors.append(np.abs(found - 40 * np.cos(40 * t))[2:-2].max())
    # Half the step gives 1/16 of the error; the next order adds (40 Ts)^2, below 1 %.
    assert errors[0] / errors[1] == pytest.approx(16.0, rel=0.02)
