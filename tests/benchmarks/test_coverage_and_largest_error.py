"""Published figures of identification: what a figure counts is what its name says."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from levid.benchmarks.identification import identification_accuracy, simulated_flight_and_truth


def test_coverage_is_the_share_of_intervals_that_contain_the_truth(monkeypatch) -> None:
    """Magnitudes err by 1 % and phases by 0.02 rad; deviations of 1 and 0.01 make it a half."""
    true = simulated_flight_and_truth.true_response(
        0.1, np.geomspace(*simulated_flight_and_truth.BAND_HZ, 40), 1000.0
    )
    wide, narrow = np.full(true.shape, np.abs(true)), np.full(true.shape, 0.01)
    found = SimpleNamespace(
        H=true * 1.01 * np.exp(0.02j), magnitude_deviation=wide, phase_deviation_rad=narrow
    )
    for name, value in {
        "flown": lambda *_: [SimpleNamespace(Ts_s=1e-3)],
        "plant_by_spectra": lambda *_: SimpleNamespace(plant=None, covariance=None),
        "response_with_errors": lambda *_: found,
    }.items():
        monkeypatch.setattr(identification_accuracy, name, value)
    figures = {figure.key: figure.value for figure in identification_accuracy.coverage(3, 10.0)}
    assert figures == {"subspace_coverage_10s_percent": 50.0}


def test_the_largest_error_is_in_dB_and_degrees_and_never_hides_a_nan() -> None:
    true = np.ones((2, 3, 3), complex) + 9.0 * np.eye(3)
    P = true * 10.0 ** (1 / 20) * np.exp(-1j * np.pi / 6)
    ratio = simulated_flight_and_truth.diagonal_ratio(P, true)
    assert simulated_flight_and_truth.worst([np.ones(2), ratio]) == pytest.approx((1.0, 30.0))
    P[1, 2, 2] = np.nan
    assert np.isnan(
        simulated_flight_and_truth.worst(
            [np.ones(2), simulated_flight_and_truth.diagonal_ratio(P, true)]
        )
    ).all()
