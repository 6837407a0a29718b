"""Test the fit to a loop's spectra on platforms that bend, flown by equations of their own."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.linalg import expm

from levid.benchmarks.identification.bending_platform import (
    COIL_NOISE_N,
    COILS,
    NOMINAL,
    SENSOR_NOISE_M,
    SENSOR_STEP_M,
    STEP_S,
    Bearing,
    BendingMode,
    Platform,
    T,
    flights,
)
from levid.config.model import ModelConfig, load_model
from levid.config.shipped import shipped
from levid.identification.greybox.declared_model_from_config import declared_model
from levid.identification.greybox.fit_in_loop import FittedLoop, fit_in_loop
from levid.identification.greybox.modes.lines_by_point import lines_by_point
from levid.identification.greybox.modes.mode import Mode
from levid.identification.greybox.modes.natural_modes import natural_modes
from levid.identification.greybox.modes.sampled_response import (
    LinearPlant,
    continuous_response,
    sensitivities,
)
from levid.identification.greybox.modes.starting_modes import starting_modes
from levid.identification.loop_spectra.output_errors import (
    residual,
    without_transients,
)
from levid.identification.loop_spectra.residual_spectrum import split_residual, with_model_error
from levid.identification.loop_spectra.spectral_lines import PointLines
from levid.identification.nonparametric.frequency_response import ResponseEstimate
from levid.identification.records.record import IdentificationError

Complex = NDArray[np.complex128]

BENDING = BendingMode(95.0, 0.01, 3.0, np.array([1, 0.2, -0.6, 0.1, -0.4, 0.3, 0.8, -0.2, 0.5]))
PLATFORM = Platform((BENDING,), Bearing(4e5))
SURE = 4.0
"""Standard errors: 30 values of one seed exceed it once in 500 draws."""


@pytest.fixture(scope="module")
def config() -> ModelConfig:
    return load_model(shipped("models/rig.yaml"))


def off(config: ModelConfig, share: float = 0.15) -> ModelConfig:
    """Return the model with declared values off by +-share, alternately."""
    changed = {
        name: p if p.is_fixed else p.model_copy(update={"value": p.value * (1 + (-1) ** k * share)})
        for k, (name, p) in enumerate(config.parameters.items())
    }
    return config.model_copy(update={"parameters": changed})


def as_modes(platform: Platform) -> tuple[Mode, ...]:
    return tuple(
        Mode(
            "bending",
            2 * np.pi * m.freq_hz,
            m.damping,
            np.outer(T @ m.shape, T @ m.shape) / m.mass_kg,
        )
        for m in platform.modes
    )


@pytest.fixture(scope="module")
def bent(config: ModelConfig) -> FittedLoop:
    return fit_in_loop(off(config), flights(PLATFORM, 1, duration_s=12.0), (), None)[1]


@pytest.fixture(scope="module")
def rigid(config: ModelConfig) -> FittedLoop:
    return fit_in_loop(off(config), flights(Platform(), 2, duration_s=12.0), (), None)[1]


@pytest.fixture(scope="module")
def point() -> PointLines:
    return lines_by_point(flights(Platform(), 3, duration_s=4.0, beams_m=(0.1,)), (0.0, 400.0))[0]


def test_response_is_that_of_the_sampled_plant_with_its_mode(
    config: ModelConfig, point: PointLines
) -> None:
    platform = Platform((BENDING,))
    A, B, _, C, _ = platform.matrices(0.1)
    n, lag, Ts = len(A), NOMINAL["lag"], point.Ts_s
    whole = np.zeros((n + 6, n + 6))
    whole[:n, :n], whole[:n, n : n + 3] = A, B @ T.T
    whole[n : n + 3, n : n + 3], whole[n : n + 3, n + 3 :] = -np.eye(3) / lag, np.eye(3) / lag
    step = expm(whole * Ts)
    z = np.exp(2j * np.pi * point.freq_hz * Ts)[:, None, None]
    inputs = np.broadcast_to(step[: n + 3, n + 3 :], (len(z), n + 3, 3))
    inner = np.linalg.solve(z * np.eye(n + 3) - step[: n + 3, : n + 3], inputs)
    true = T @ C @ inner[:, :n] / z  # one cycle late

    found = LinearPlant(declared_model(config), as_modes(platform)).response(point)

    size = np.abs(true).max(axis=(1, 2), keepdims=True)
    assert np.max(np.abs(found - true) / size) < 1e-4


def test_sensitivities_are_differences_of_the_response(
    config: ModelConfig, point: PointLines
) -> None:
    body = Mode("attached", 500.0, 0.03, np.diag([1e-4, 5e-3, 1e-2]) + 1e-4)
    plant = LinearPlant(declared_model(config), (*as_modes(Platform((BENDING,))), body))
    names = ("m_b", "d", "k_thetaz", "lag", "delay", (0, "omega"), (0, "damping"), (0, 1, 2),
             (1, "omega"), (1, 0, 1))  # fmt: skip
    steps = np.array([1e-4, 1e-4, 1e-3, 1e-8, 1e-8, 1e-3, 1e-6, 1e-6, 1e-3, 1e-9])
    found = sensitivities(plant, point, names, np.array([1.4, 4, 6, 3e-4, 1e-4, *[1.0] * 5]))
    for k, name in enumerate(names):
        step = np.array([steps[k]])
        high, low = (plant.moved([name], x).response(point) for x in (step, -step))
        slope = (high - low) / (2 * steps[k])
        # The images beyond the second are left out: 2 % of a lag's effect at 0.4 of the rate.
        assert np.linalg.norm(found[k] - slope) < 0.02 * np.linalg.norm(slope), name


def test_begin_and_end_of_a_record_leave_nothing(config: ModelConfig) -> None:
    # Four seconds are two periods of the slowest mode: transients are as large as the response.
    records = flights(Platform(), 4, duration_s=4.0, beams_m=(0.0,))
    (at,) = lines_by_point(records, (0.0, 400.0))
    plant = LinearPlant(declared_model(config))
    whole, _, _ = residual(plant, at)
    cleaned = without_transients(plant, at, None)
    for record, before, after in zip(at.records, whole, cleaned, strict=True):
        j = record.excited[0]
        size = np.abs(record.Y[:, j]).mean()
        assert np.abs(before[:, j]).mean() > 0.05 * size
        assert np.abs(after[:, j]).mean() < 0.02 * size  # the noise


def test_noise_and_model_error_are_told_apart(point: PointLines) -> None:
    rng = np.random.default_rng(5)
    F = len(point.freq_hz)
    noise, wrong = 1e-3, np.abs(point.freq_hz - 200.0) < 20.0
    residuals = []
    for r in point.records:
        E = noise * (rng.normal(size=(F, 3)) + 1j * rng.normal(size=(F, 3))) / np.sqrt(2.0)
        V = r.V[:, r.excited[0]] / np.abs(r.V[:, r.excited[0]]).std()
        residuals.append(E + 0.1 * (wrong * V)[:, None])
    found = split_residual(point, residuals)
    measured = np.einsum("fii->fi", found.noise).real
    assert np.median(measured) == pytest.approx(noise**2, rel=0.05)
    z = found.excess / found.excess_sd
    inside = np.abs(found.freq_hz - 200.0) < 10.0
    assert np.all(z[inside] > 100.0)
    assert np.max(z[np.abs(found.freq_hz - 200.0) > 30.0]) < 6.0
    assert np.all(found.clear_error[np.abs(point.freq_hz - 200.0) > 40.0] == 0.0)
    assert np.all(found.clear_error[np.abs(point.freq_hz - 200.0) < 10.0] > 0.0)


def test_records_of_one_point_may_have_noise_of_different_size(point: PointLines) -> None:
    F = len(point.freq_hz)
    rng, sizes = np.random.default_rng(3), np.array([1.0, 2.0, 4.0])
    residuals = [
        s * (rng.normal(size=(F, 3)) + 1j * rng.normal(size=(F, 3))) / np.sqrt(2.0) for s in sizes
    ]
    found = split_residual(point, residuals)
    # 1600 lines of 3 outputs determine a power to 1.4 %.
    np.testing.assert_allclose(found.levels, sizes**2 / np.mean(sizes**2), rtol=0.06)
    for covariance, size in zip(with_model_error(point, found, 0.0), sizes, strict=True):
        assert np.median(np.einsum("fii->fi", covariance).real) == pytest.approx(size**2, rel=0.06)


def test_each_natural_frequency_says_what_it_belongs_to(bent: FittedLoop) -> None:
    """A body on the structure resonates above its own frequency on a base at rest."""
    found = natural_modes(bent.fit.plant, {"x_b": 0.1, "v_b": 0.0, "a_b": 0.0})
    A = PLATFORM.matrices(0.1)[0]
    poles = np.linalg.eigvals(A)
    true = np.sort(np.abs(poles[poles.imag > 0])) / (2.0 * np.pi)
    # A bearing that slips is softer than at rest.
    np.testing.assert_allclose([f for f, _ in found], true, rtol=1e-2)
    assert [origin for _, origin in found] == ["declared"] * 3 + ["attached", "bending"]


def test_vector_fitting_finds_modes_of_a_response() -> None:
    second = BendingMode(180.0, 0.02, 1.0, np.roll(BENDING.shape, 4))
    platform, freq_hz = Platform((BENDING, second)), np.linspace(20.0, 400.0, 600)
    H = [platform.response(x, freq_hz) for x in (-0.1, 0.1)]
    sd = 1e-3 * np.abs(H[0])
    covariance = np.zeros((600, 3, 3, 3, 3), complex)
    for i in range(3):
        for j in range(3):
            covariance[:, i, j, i, j] = sd[:, i, j] ** 2
    found = starting_modes(
        [ResponseEstimate(freq_hz, h, np.ones(h.shape), covariance, 1e-3) for h in H], 20.0
    )
    by_frequency = sorted(found, key=lambda m: m.omega)
    for mode, true in zip(by_frequency, as_modes(platform), strict=True):
        assert mode.omega == pytest.approx(true.omega, rel=1e-4)
        assert mode.damping == pytest.approx(true.damping, rel=1e-2)
        assert np.allclose(mode.strength, true.strength, atol=0.02 * np.abs(true.strength).max())


@pytest.mark.parametrize("name", ["m_p", "m_b", "J_psitheta", "d", "k_z", "k_psiz", "lag", "delay"])
def test_parameters_beside_modes_are_right(bent: FittedLoop, name: str) -> None:
    k = bent.fit.names.index(name)
    se = np.sqrt(bent.fit.covariance[k, k])
    assert abs(bent.fit.plant.model.values[name] - NOMINAL[name]) < SURE * se
    if name == "m_p":  # 9 % wrong by prediction errors
        assert se < 1e-4 * NOMINAL[name]


def test_a_bending_mode_is_told_from_a_body_in_a_bearing(bent: FittedLoop) -> None:
    kinds = {m.kind: m for m in bent.fit.modes}
    assert len(bent.fit.modes) == 2
    bending, body = kinds["bending"], kinds["attached"]
    se, _ = bent.fit.mode_errors(bending)
    assert abs(bending.freq_hz - BENDING.freq_hz) < SURE * se < 0.01
    shape = T @ BENDING.shape
    true = np.outer(shape, shape) / BENDING.mass_kg
    assert np.allclose(bending.strength, true, atol=0.01 * np.abs(true).max())
    # The beam is carried along by theta, at the height z_b.
    assert body.strength[1, 1] == pytest.approx(NOMINAL["m_b"] * NOMINAL["z_b"] ** 2, rel=0.05)


def test_valid_band_ends_where_the_truth_says(bent: FittedLoop) -> None:
    freq_hz = np.geomspace(1.0, 300.0, 3000)
    first = np.inf
    for x_b in (-0.1, 0.0, 0.1):
        whole, stiff = (p.response(x_b, freq_hz) for p in (PLATFORM, Platform()))
        wrong = np.abs(whole - stiff) > bent.band.share * np.abs(whole)
        first = min(first, freq_hz[np.argmax(np.any(wrong[:, range(3), range(3)], axis=1))])
    assert not bent.band.complete
    assert bent.band.end_hz == pytest.approx(first, rel=0.05)


def test_a_rigid_platform_has_no_modes_and_one_band(rigid: FittedLoop) -> None:
    assert rigid.fit.modes == ()
    assert rigid.fit.white
    assert rigid.band.complete
    assert rigid.over_noise < 1.2  # of records of 12 s, which have a spread of 5 %


def test_noise_is_measured_and_not_the_misfit(bent: FittedLoop, rigid: FittedLoop) -> None:
    force = COIL_NOISE_N**2 * STEP_S * np.diag(COILS.T @ COILS)
    sensor = (SENSOR_NOISE_M**2 + SENSOR_STEP_M**2 / 12) * np.diag(T @ T.T)
    for loop, limit in ((rigid, 1.15), (bent, 1.5)):  # yielding of the bearing is partly noise
        ratio = [*(loop.fit.noise.force_psd / force), *(loop.fit.noise.output_variance / sensor)]
        assert max(np.max(ratio), 1.0 / np.min(ratio)) < limit


def test_a_lag_never_becomes_zero(config: ModelConfig) -> None:
    # At 0 it is told from the delay no more, and would stay there.
    records = flights(Platform((BENDING,)), 6, duration_s=6.0)
    slow = config.parameters["lag"].model_copy(update={"value": 6e-4})
    start = config.model_copy(update={"parameters": {**config.parameters, "lag": slow}})
    _, loop = fit_in_loop(start, records, (), None)
    assert loop.fit.plant.model.values["lag"] == pytest.approx(NOMINAL["lag"], rel=0.1)


def test_attached_and_bending_mode_have_the_same_resonance_in_the_response(
    config: ModelConfig,
) -> None:
    plant = LinearPlant(declared_model(config), as_modes(Platform((BENDING,))))
    freq_hz = np.linspace(90.0, 100.0, 2001)
    schedule = {"x_b": 0.0, "v_b": 0.0, "a_b": 0.0}
    M = plant.model.at(schedule).M
    strength = M @ plant.modes[0].strength @ M
    share = np.max(np.linalg.eigvals(np.linalg.solve(M, strength)).real)
    omega = plant.modes[0].omega * np.sqrt(1 - share)
    other = replace(plant, modes=(Mode("attached", omega, 0.01, strength),))
    peaks = [
        freq_hz[np.argmax(np.abs(continuous_response(p, schedule, freq_hz)[:, 0, 0]))]
        for p in (plant, other)
    ]
    assert peaks[0] == pytest.approx(peaks[1], rel=2e-3)


def test_records_at_one_position_up_to_jitter_are_one_point() -> None:
    records = flights(Platform(), 7, duration_s=1.0, beams_m=(0.0333,))
    jitter = (-1e-8, 0.0, 1e-8)
    moved = [
        replace(e, schedule={**e.schedule, "x_b": e.schedule["x_b"] + x})
        for e, x in zip(records, jitter, strict=True)
    ]
    assert len(lines_by_point(moved, (0.0, 400.0))) == 1
    assert len(lines_by_point([*moved, *flights(Platform(), 7, duration_s=1.0)], (0.0, 400.0))) == 4


def test_a_band_without_lines_is_refused_with_a_remedy() -> None:
    records = flights(Platform(), 7, duration_s=1.0, beams_m=(0.0,))
    with pytest.raises(IdentificationError, match="one line each 1 Hz, up to 500 Hz"):
        lines_by_point(records, (100.0, 110.0))
