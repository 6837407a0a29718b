"""Test the residual force of a model: its value, its noise and its dependence on signals."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from effect_test_helpers import rig_places

from levid.config.base import parse_text
from levid.config.model import ModelConfig
from levid.identification.greybox.declared_model_from_config import declared_model
from levid.identification.greybox.experiment.experiment_from_log import Experiment
from levid.identification.greybox.free_parameters import free_parameters
from levid.identification.greybox.prediction.noise_model import Noise
from levid.identification.trace.linearised.linearisation_point import WorkingPoint
from levid.identification.trace.records.record_from_log import TraceRecord
from levid.identification.trace.records.sensor_and_amplifier_noise import Disturbance
from levid.identification.trace.residual.binned_means import dependence
from levid.identification.trace.residual.force_residual import (
    beyond_rigid,
    denoised,
    density,
    false_density,
    missing,
    noise_density,
    standing_out,
)
from levid.model.effects.base import Places

TS = 1e-3
M, D, K = 2.0, 3.0, 800.0
MODEL = f"""
levid: model
name: one
dof: [{{name: x, unit: m}}]
inputs: [{{name: u, unit: N}}]
parameters:
  m: {{value: {M}, unit: kg}}
M: [[m]]
D: [[{D}]]
K: [[{K}]]
"""


def record(y: np.ndarray, u: np.ndarray, places: Places) -> TraceRecord:
    N = len(y)
    experiment = Experiment("made", TS, u, y, {}, frozenset(), False)
    none = np.zeros((N, 3))
    return TraceRecord(
        experiment, places, TS * np.arange(N), y @ places.sensor_shape.T, u, np.zeros_like(u),
        none, none, None, "wrench",
    )  # fmt: skip


@pytest.fixture
def places() -> Places:
    one, nowhere = np.eye(1), np.zeros((0, 2))
    return Places(("x",), ("m",), one, one, "N", ("N",), "m", nowhere, nowhere, beam=False)


def point(sensor_sd: float, force_psd: float) -> WorkingPoint:
    config = parse_text(MODEL, ModelConfig, "made")
    noise = Noise.independent(np.array([force_psd]), np.array([sensor_sd**2]))
    disturbance = Disturbance(noise, sensor_sd, measured=True)
    return WorkingPoint(
        declared_model(config), free_parameters(config), (), disturbance, config.input
    )


def moved_by(force: dict[float, complex], t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the steady-state motion x and the force (N,) for amplitudes by frequency in Hz."""
    x, f = np.zeros(len(t)), np.zeros(len(t))
    for hz, amplitude in force.items():
        s = 2j * np.pi * hz
        wave = np.exp(s * t)
        x += np.real(amplitude / (M * s * s + D * s + K) * wave)
        f += np.real(amplitude * wave)
    return x, f


def test_residual_force_equals_the_applied_force(places: Places) -> None:
    t = TS * np.arange(8000)
    x, force = moved_by({1.5: 0.02, 7.25: 0.01j, 31.0: -0.015}, t)
    found = missing(point(1e-9, 1e-8), record(x[:, None], np.zeros((8000, 1)), places)).force[:, 0]
    # Each row has the mean over the following period, which is the force half a period later.
    _, later = moved_by({1.5: 0.02, 7.25: 0.01j, 31.0: -0.015}, t + TS / 2)
    inner = slice(600, -600)  # both ends are tapered
    # A mean over 1 ms is smaller than the value at its middle by (w Ts)^2 / 24 = 0.16 % at 31 Hz.
    np.testing.assert_allclose(found[inner], later[inner], atol=3e-3 * np.abs(force).max())


def test_noise_of_the_residual_force_agrees_with_its_density(places: Places) -> None:
    rng = np.random.default_rng(2)
    sd = 1e-7
    y = sd * rng.standard_normal((60_000, 1))
    at = point(sd, 1e-20)
    residual = missing(at, record(y, np.zeros((60_000, 1)), places))
    freq_hz, psd = density(residual.force, TS)
    noise = noise_density(at, residual.here, freq_hz)
    band = (freq_hz > 1) & (freq_hz < 60)
    # 29 averages of 236 lines: the mean ratio scatters by 1.2 %. Differences instead of derivatives
    # lose (w Ts)^2 / 12 of M w^2, which is 2.4 % of the power at 60 Hz.
    assert np.mean(psd[band] / noise[band]) == pytest.approx(1.0, abs=0.06)
    # Noise alone gives no gain.
    gain = standing_out(psd, noise, freq_hz)
    assert np.mean(gain[freq_hz < 60]) < 0.02


def test_noise_of_one_sensor_is_not_taken_for_a_force(places: Places) -> None:
    rng = np.random.default_rng(3)
    sd, three = 1e-7, replace(places, sensor_shape=np.ones((3, 1)))
    errors = sd * rng.standard_normal((60_000, 3)) * [1.0, 5.0, 1.0]
    moved = errors.mean(axis=1, keepdims=True)
    logged = replace(record(moved, np.zeros((60_000, 1)), three), gap=errors)
    at = point(sd, 1e-20)
    at = replace(
        at,
        disturbance=replace(
            at.disturbance, noise=Noise.independent(*np.array([[1e-20], [sd**2 / 3]]))
        ),
    )
    residual = missing(at, logged)
    freq_hz, psd = density(residual.force, TS)
    expected_psd = noise_density(at, residual.here, freq_hz)
    false = false_density(at, residual.here, residual.reading)
    band = (freq_hz > 5) & (freq_hz < 60)
    # The power is 27 / 3 of the expected one; third-octave bands detect all of it within 3 %.
    assert np.mean(psd[band] / expected_psd[band]) == pytest.approx(9.0, rel=0.06)
    assert np.mean(psd[band] / (expected_psd + false)[band]) == pytest.approx(1.0, abs=0.08)
    # A motion in all sensors is not a false reading.
    x, _ = moved_by({12.0: 0.02}, TS * np.arange(60_000))
    true_gap = sd * rng.standard_normal((60_000, 3)) + x[:, None]
    y = true_gap.mean(axis=1, keepdims=True)
    residual = missing(at, replace(record(y, np.zeros((60_000, 1)), three), gap=true_gap))
    false = false_density(at, residual.here, residual.reading)
    assert np.mean((false / expected_psd)[band]) < 0.15


def test_denoising_preserves_the_phase() -> None:
    t = TS * np.arange(10_000)
    wave = np.sin(2 * np.pi * 3 * t)
    noise = np.random.default_rng(1).standard_normal(len(t))
    freq_hz = np.linspace(0, 500, 2001)
    gain = ((freq_hz > 1) & (freq_hz < 8)).astype(float)
    kept = denoised(wave + 0.1 * noise, gain, freq_hz, TS)
    inner = slice(1000, -1000)
    # 7 Hz of 500 Hz of the noise remain: 0.1 sqrt(7 / 500) = 0.012 RMS.
    assert np.sqrt(np.mean((kept - wave)[inner] ** 2)) < 0.02


def test_rigid_pose_has_no_nonrigid_residual() -> None:
    rng = np.random.default_rng(0)
    pose = rng.standard_normal((50, 3))
    made = record(pose, np.zeros((50, 3)), rig_places())
    np.testing.assert_allclose(beyond_rigid(made, made.gap), 0.0, atol=1e-12)
    false = made.gap.copy()
    false[:, 4] += 1.0
    # A ninth of the false reading of the middle sensor is taken for height.
    np.testing.assert_allclose(beyond_rigid(made, false)[:, 4], 8 / 9, atol=1e-12)


def test_dependence_is_found_for_a_curve_and_not_for_noise() -> None:
    rng = np.random.default_rng(4)
    x = rng.uniform(-1, 1, 20_000)
    block = np.repeat(np.arange(40), 500)
    noise = 0.1 * rng.standard_normal(len(x))
    found = dependence(x, x**3 + noise, block)
    # Within a bin, 1/24 of the range, x^3 varies by less than the noise.
    assert found.share == pytest.approx(1 - 0.01 / (1 / 7 + 0.01), abs=0.02)
    apart = np.abs(found.mean - found.at**3)
    # The mean of x^3 in a bin differs from the cube of the mean by 3 x var < 0.002.
    assert np.mean(apart < 1.96 * found.error + 2e-3) > 0.85
    assert abs(dependence(rng.uniform(-1, 1, len(x)), x**3 + noise, block).share) < 0.01


def test_standard_errors_account_for_correlation_within_blocks() -> None:
    # A constant value in a block counts as one observation.
    rng = np.random.default_rng(7)
    x = rng.uniform(-1, 1, 20_000)
    block = np.repeat(np.arange(40), 500)
    lasting = np.repeat(rng.standard_normal(40), 500)
    found = dependence(x, lasting, block)
    # The error of a mean of 40 values of unit variance; its estimate scatters by 11 %.
    assert np.mean(found.error) == pytest.approx(1 / np.sqrt(40), rel=0.3)
