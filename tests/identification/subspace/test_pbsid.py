"""Test predictor-based subspace identification against an independent simulation of the rig."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import signal

from levid.identification.records.record import IdentificationError, PiController, Record
from levid.identification.subspace.pbsid import grams_of_lags, plant_by_subspace

FREQ_HZ = np.geomspace(1.0, 64.0, 40)


def test_without_noise_the_plant_is_exact_and_has_six_states(rig):
    found = plant_by_subspace(
        rig.records([0.1], 1e3, 10.0, noise=False), lag_pole=np.exp(-1e-3 / rig.LAG_S)
    )
    assert found.plant.core.A.shape == (6, 6)
    true = rig.sampled_plant(0.1, 1e-3).frequency_response(FREQ_HZ)
    # The regularisation of the Gram matrices costs 1e-9.
    assert np.abs(found.plant.response(FREQ_HZ) / true - 1).max() < 1e-7


def test_unknown_lag_adds_three_states(rig):
    found = plant_by_subspace(rig.records([0.1], 1e3, 10.0, noise=False), order=9)
    true = rig.sampled_plant(0.1, 1e-3).frequency_response(FREQ_HZ)
    assert np.abs(found.plant.response(FREQ_HZ) / true - 1).max() < 1e-7
    # At 1 kHz a lag of 0.3 ms is a fast pole, e^(-1 / 0.3) = 0.036.
    fast = np.sort(np.abs(np.linalg.eigvals(found.plant.core.A)))[:3]
    np.testing.assert_allclose(fast, np.exp(-1e-3 / rig.LAG_S), rtol=0.01)


@pytest.mark.parametrize(("rate_hz", "duration_s"), [(1e3, 20.0), (1e4, 10.0)])
def test_diagonal_is_accurate_to_0_2_percent_with_the_rigs_noise(rig, rate_hz, duration_s):
    found = plant_by_subspace(
        rig.records([0.1], rate_hz, duration_s), lag_pole=np.exp(-1 / rate_hz / rig.LAG_S)
    )
    assert found.plant.core.A.shape == (6, 6)
    true = rig.sampled_plant(0.1, 1 / rate_hz).frequency_response(FREQ_HZ)
    ratio = np.einsum("fii->fi", found.plant.response(FREQ_HZ)) / np.einsum("fii->fi", true)
    # The largest error over seeds is 2e-4 to 7e-4 (0.006 dB).
    assert np.abs(ratio - 1).max() < 2e-3
    # The innovation consists of the sensors' noise and their 16-bit quantisation.
    sensor_m = np.hypot(rig.SENSOR_NOISE_M, rig.SENSOR_STEP_M / np.sqrt(12))
    pose = np.linalg.norm(rig.T, axis=1) * sensor_m
    # The prediction error adds a few percent with a past of 10 to 100 samples.
    np.testing.assert_allclose(np.sqrt(np.diag(found.innovation_covariance)), pose, rtol=0.1)


def test_feedback_of_strong_noise_gives_no_bias():
    # 0.5 z^-2 / (1 - 1.5 z^-1 + 0.7 z^-2) under feedback. Much of the output is coloured noise that
    # the controller feeds back to u, so the ratio of the spectra of y and u is biased towards minus
    # the inverse of the controller.
    rng = np.random.default_rng(1)
    rows, controller = 40_000, PiController(np.array([0.2]), np.array([0.0]))
    v = rng.normal(size=rows)
    noise = signal.lfilter([0.5], [1.0, -0.9], rng.normal(size=rows))
    u, y, x = np.zeros(rows), np.zeros(rows), np.zeros(rows + 2)
    for k in range(rows):
        x[k] = 1.5 * x[k - 1] - 0.7 * x[k - 2] + (0.5 * u[k - 2] if k > 1 else 0.0)
        y[k] = x[k] + noise[k]
        u[k] = v[k] - 0.2 * y[k]
    record = Record(
        "r", 1.0, v[:, None], y[:, None], ("a",), ("N",), ("b",), ("m",), u=u[:, None],
        controller=controller, delay_cycles=1,
    )  # fmt: skip
    found = plant_by_subspace([record], order=3, past=30).plant
    freq_hz = np.linspace(0.005, 0.2, 30)
    z = np.exp(2j * np.pi * freq_hz)
    true = 0.5 / (z**2 - 1.5 * z + 0.7)
    largest = np.abs(true).max()
    error = np.abs(found.response(freq_hz)[:, 0, 0] - true) / largest
    # Over seeds the error is 0.01 to 0.04, at low frequencies where noise equals the signal.
    assert error.max() < 0.1
    freq, across = signal.csd(u, y, nperseg=400)
    direct = across / signal.welch(u, nperseg=400)[1]
    nearest = np.searchsorted(freq, freq_hz)
    assert (np.abs(direct[nearest] - true) / largest).max() > 0.5  # 0.9 to 1.0 over seeds


def test_gram_matrix_equals_that_of_explicit_lags():
    rng = np.random.default_rng(2)
    signals, lags = [rng.normal(1.0, 1.0, (n, 3)) for n in (300, 2000)], 7
    for z, gram in zip(signals, grams_of_lags(signals, lags), strict=True):
        rows = np.hstack([z[lags - a : len(z) - a] for a in range(lags + 1)])
        rows -= rows.mean(axis=0)
        # Sums of 2000 products of order 1, by FFT: rounding is 1e-16 of the sum of squares.
        np.testing.assert_allclose(gram, rows.T @ rows, atol=1e-10)


def test_unusable_records_are_rejected_with_the_reason(rig):
    records = rig.records([0.1], 1e3, 2.0)
    with pytest.raises(IdentificationError, match=r"'psi-0': expected the plant input"):
        plant_by_subspace([replace(r, u=None) for r in records])
    with pytest.raises(IdentificationError, match=r"'psi-0': expected a known delay"):
        plant_by_subspace([replace(r, delay_cycles=None) for r in records])
    with pytest.raises(IdentificationError, match=r"1932 in all, found 398, 398"):
        plant_by_subspace([r.rows(0, 400) for r in records[:2]], past=160)
    with pytest.raises(IdentificationError, match="order of 1 to 24, found 99"):
        plant_by_subspace(records, order=99)
    still = [replace(r, u=np.zeros_like(r.v)) for r in records]
    with pytest.raises(IdentificationError, match="found a constant one"):
        plant_by_subspace(still)
