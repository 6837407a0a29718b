"""Test the plant of a loop by subspace and likelihood: exactness, order, coverage, errors."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from levid.benchmarks.identification.bending_platform import NOMINAL, BendingMode, Platform
from levid.benchmarks.identification.bending_platform_states import records_of
from levid.identification.identify import identify
from levid.identification.options import Options
from levid.identification.records.record import IdentificationError, PiController, Record
from levid.identification.records.signal_names import SignalNames
from levid.identification.results import IdentificationResult
from levid.identification.results_to_json import summary
from levid.identification.subspace.plant_by_spectra import plant_by_spectra
from levid.identification.subspace.plant_from_loop import IdentifiedPlant
from levid.identification.subspace.response_uncertainty import modes, response_with_errors
from levid.model.second_order import StateSpace

FREQ_HZ = np.geomspace(0.01, 0.4, 25)
SURE_95 = 1.96
# Two axes that couple, 1 Hz sampling: damped oscillations at 0.08 and 0.16 Hz.
A = np.array([[1.7, -0.85, 0.1, 0.0], [1, 0, 0, 0], [0.1, 0.0, 1.0, -0.8], [0, 0, 1, 0]])
B = np.array([[1.0, 0.2], [0, 0], [0.3, 1.0], [0, 0]])
C = np.array([[0.1, 0.05, 0.0, 0.0], [0.0, 0.0, 0.2, 0.1]])
GAIN = 0.3


def flown(seed: int, rows: int, noise: float, noisier: float = 1.0) -> list[Record]:
    """Return a record for each input, u = v - 0.3 y; `noisier` scales the noise of the second."""
    rng = np.random.default_rng(seed)
    records = []
    for axis in range(2):
        v = np.zeros((rows, 2))
        v[:, axis] = rng.normal(size=rows)
        size = noise * noisier**axis
        e, force = size * rng.normal(size=(rows, 2)), 0.3 * size * rng.normal(size=(rows, 2))
        x, u, y = np.zeros(4), np.zeros((rows, 2)), np.zeros((rows, 2))
        held = np.zeros(2)
        for k in range(rows):
            y[k] = C @ x + e[k]
            u[k] = v[k] - GAIN * y[k]
            x = A @ x + B @ (held + force[k])
            held = u[k]
        records.append(
            Record(
                f"r{axis}", 1.0, v, y, ("a", "b"), ("N", "N"), ("c", "d"), ("m", "m"), u=u,
                controller=PiController(np.full(2, GAIN), np.zeros(2)), delay_cycles=1,
            )
        )  # fmt: skip
    return records


def truth(freq_hz: np.ndarray) -> np.ndarray:
    z = np.exp(2j * np.pi * freq_hz)[:, None, None]
    return C @ np.linalg.solve(z * np.eye(4) - A, B) / z


def coverage(seeds: range, rows: int, noisier: float = 1.0) -> dict[str, float]:
    """Return the share of 95 % intervals that contain the truth, over entries and seeds."""
    true = truth(FREQ_HZ)
    poles = np.log(np.linalg.eigvals(A).astype(complex))
    poles = poles[poles.imag > 0]
    poles = poles[np.argsort(np.abs(poles))]
    held: dict[str, list[float]] = {"magnitude": [], "phase": [], "modes": []}
    for seed in seeds:
        found = plant_by_spectra(flown(seed, rows, 0.1 / noisier, noisier))
        assert found.order == 4
        P = response_with_errors(found.plant, found.covariance, FREQ_HZ)
        off = np.abs(np.abs(P.H) - np.abs(true)) / P.magnitude_deviation
        turned = np.abs(np.angle(P.H / true)) / P.phase_deviation_rad
        m = modes(found.plant.core, found.covariance)
        z = [
            (m.frequency_hz - np.abs(poles) / (2 * np.pi)) / m.frequency_se_hz,
            (m.damping + poles.real / np.abs(poles)) / m.damping_se,
        ]
        held["magnitude"].append(float(np.mean(off < SURE_95)))
        held["phase"].append(float(np.mean(turned < SURE_95)))
        held["modes"].append(float(np.mean(np.abs(z) < SURE_95)))
    return {name: float(np.mean(values)) for name, values in held.items()}


@pytest.fixture(scope="module")
def exact() -> tuple[IdentifiedPlant, np.ndarray]:
    """Return the true plant and a covariance of [A B; C D] with independent entries."""
    core = StateSpace(A, B, C, np.zeros((2, 2)), 1.0)
    return IdentifiedPlant(core, 1), 1e-12 * np.eye(36).reshape(6, 6, 6, 6)


# 40 seeds with about 8 independent numbers each: two standard deviations of 95 % are 2.4 %.
def test_confidence_intervals_have_95_percent_coverage():
    share = coverage(range(40), 1200)
    for name, value in share.items():
        assert 0.92 <= value <= 0.98, (name, share)


def test_coverage_holds_for_records_with_different_noise():
    share = coverage(range(40), 1200, noisier=5.0)
    for name, value in share.items():
        assert 0.92 <= value <= 0.98, (name, share)


def test_standard_errors_fall_with_the_root_of_the_length():
    def size(rows):
        found = plant_by_spectra(flown(1, rows, 0.1), 4)
        # In the band that both lengths determine.
        freq_hz = np.linspace(0.02, 0.2, 25)
        return response_with_errors(found.plant, found.covariance, freq_hz).standard_deviation

    # Shorter records have few lines at a resonance, whose power is a matter of chance.
    assert np.mean(size(2400) / size(9600)) == pytest.approx(2.0, rel=0.2)


RIG_HZ = np.geomspace(1.0, 64.0, 40)


def test_without_noise_the_plant_is_exact_and_has_six_states(rig):
    lag_pole = np.exp(-1e-3 / rig.LAG_S)
    found = plant_by_spectra(rig.records([0.1], 1e3, 10.0, noise=False), lag_pole=lag_pole)
    assert found.plant.core.A.shape == (6, 6)
    true = rig.sampled_plant(0.1, 1e-3).frequency_response(RIG_HZ)
    response = response_with_errors(found.plant, found.covariance, RIG_HZ)
    error, size, sd = (
        np.einsum("fii->fi", np.abs(x))
        for x in (response.H - true, true, response.standard_deviation)
    )
    # Rounding weighs as noise, most at the resonances, so it is exact up to its own intervals.
    assert np.all(error < 4.0 * sd)
    assert np.max(error / size) < 1e-3


def test_unknown_lag_adds_three_states(rig):
    found = plant_by_spectra(rig.records([0.1], 1e3, 10.0, noise=False))
    true = rig.sampled_plant(0.1, 1e-3).frequency_response(RIG_HZ)
    assert found.order == 9
    assert np.abs(found.plant.response(RIG_HZ) / true - 1).max() < 1e-7
    # At 1 kHz a lag of 0.3 ms is a fast pole, e^(-1 / 0.3) = 0.036.
    fast = np.sort(np.abs(np.linalg.eigvals(found.plant.core.A)))[:3]
    np.testing.assert_allclose(fast, np.exp(-1e-3 / rig.LAG_S), rtol=0.01)


@pytest.mark.parametrize(("rate_hz", "duration_s"), [(1e3, 20.0), (1e4, 10.0)])
def test_diagonal_is_accurate_to_0_1_percent_with_the_rigs_noise(rig, rate_hz, duration_s):
    found = plant_by_spectra(
        rig.records([0.1], rate_hz, duration_s), lag_pole=np.exp(-1 / rate_hz / rig.LAG_S)
    )
    assert found.order == 6
    assert found.doubtful_orders == ()
    assert found.white
    true = rig.sampled_plant(0.1, 1 / rate_hz).frequency_response(RIG_HZ)
    ratio = np.einsum("fii->fi", found.plant.response(RIG_HZ)) / np.einsum("fii->fi", true)
    # The largest error over seeds is 2e-4.
    assert np.abs(ratio - 1).max() < 1e-3


@pytest.mark.parametrize("excitation", ["noise", "multisine"])
def test_modes_of_a_platform_that_bends_are_states(excitation):
    shape = np.array([1, 0.2, -0.6, 0.1, -0.4, 0.3, 0.8, -0.2, 0.5])
    platform = Platform(
        (BendingMode(95.0, 0.01, 3.0, shape), BendingMode(150.0, 0.01, 5.0, -shape))
    )
    found = plant_by_spectra(
        records_of(platform, 1, excitation, 0.0), lag_pole=np.exp(-1e-3 / NOMINAL["lag"])
    )
    assert found.order == 10
    assert found.white
    m = modes(found.plant.core, found.covariance)
    for true, k in (95.0, 3), (150.0, 4):
        assert abs(m.frequency_hz[k] - true) < 4.0 * m.frequency_se_hz[k]
    freq_hz = np.geomspace(1.0, 200.0, 100)
    P = response_with_errors(found.plant, found.covariance, freq_hz)
    off = np.abs(P.H - platform.sampled_response(0.0, freq_hz, 1e-3)) / P.standard_deviation
    # A hundred frequencies with 9 entries depend on 69 numbers: none reaches 4.5 deviations.
    assert off.max() < 4.5


def test_records_may_have_different_lengths(rig):
    cut = [r.rows(0, len(r.y) - 37 * k) for k, r in enumerate(rig.records([0.1], 1e3, 12.0))]
    found = plant_by_spectra(cut, lag_pole=np.exp(-1e-3 / rig.LAG_S))
    assert found.order == 6
    P = response_with_errors(found.plant, found.covariance, RIG_HZ)
    true = rig.sampled_plant(0.1, 1e-3).frequency_response(RIG_HZ)
    assert np.all(np.abs(P.H - true) < 4.5 * P.standard_deviation)


def test_noise_and_multisines_at_one_point_are_used_together():
    one, other = (records_of(Platform(), 3, kind, 0.0) for kind in ("noise", "multisine"))
    found = plant_by_spectra([*one, *other], lag_pole=np.exp(-1e-3 / NOMINAL["lag"]))
    assert found.order == 6
    P = response_with_errors(found.plant, found.covariance, RIG_HZ)
    off = np.abs(P.H - Platform().sampled_response(0.0, RIG_HZ, 1e-3)) / P.standard_deviation
    assert off.max() < 4.5


def test_an_order_that_is_given_is_kept(rig):
    records = rig.records([0.1], 1e3, 4.0)
    assert plant_by_spectra(records, 8).order == 8
    with pytest.raises(IdentificationError, match="order of 1 to 24, found 99"):
        plant_by_spectra(records, 99)


def test_unusable_records_are_rejected_with_the_reason(rig):
    records = rig.records([0.1], 1e3, 4.0)
    with pytest.raises(IdentificationError, match=r"'psi-0': expected the plant input"):
        plant_by_spectra([replace(r, u=None) for r in records])
    with pytest.raises(IdentificationError, match=r"'psi-0': expected a known delay"):
        plant_by_spectra([replace(r, delay_cycles=None) for r in records])
    with pytest.raises(IdentificationError, match="excitation of every input"):
        plant_by_spectra(records[:2])
    with pytest.raises(IdentificationError, match="record"):
        plant_by_spectra([r.rows(0, 40) for r in records])


def test_errors_of_response_and_modes_agree_with_perturbed_matrices(exact):
    plant, covariance = exact
    rng = np.random.default_rng(3)
    draws = 1e-6 * rng.normal(size=(4000, 6, 6))
    H, f = [], []
    for d in draws:
        core = StateSpace(A + d[:4, :4], B + d[:4, 4:], C + d[4:, :4], d[4:, 4:], 1.0)
        H.append(IdentifiedPlant(core, 1).response(FREQ_HZ))
        f.append(modes(core, covariance))
    P, m = response_with_errors(plant, covariance, FREQ_HZ), modes(plant.core, covariance)
    # 4000 draws determine a standard deviation to 1.1 %; the worst of 100 is off by 3 times this.
    tolerance = 0.04
    spread = np.abs(np.array(H)).std(axis=0) / P.magnitude_deviation
    np.testing.assert_allclose(spread, 1.0, atol=tolerance)
    turned = np.angle(np.array(H) / P.H).std(axis=0) / P.phase_deviation_rad
    np.testing.assert_allclose(turned, 1.0, atol=tolerance)
    np.testing.assert_allclose(
        np.std([x.frequency_hz for x in f], axis=0) / m.frequency_se_hz, 1.0, atol=tolerance
    )
    np.testing.assert_allclose(
        np.std([x.damping for x in f], axis=0) / m.damping_se, 1.0, atol=tolerance
    )


def test_positive_real_poles_are_modes_and_negative_ones_are_not():
    core = StateSpace(np.diag([0.5, -0.5, 0.0, 1.5]), B, C, np.zeros((2, 2)), 0.1)
    m = modes(core, np.zeros((6, 6, 6, 6)))
    np.testing.assert_allclose(m.frequency_hz, np.abs(np.log([1.5, 0.5])) / 0.1 / (2 * np.pi))
    np.testing.assert_allclose(m.damping, [-1.0, 1.0])
    np.testing.assert_allclose(m.damping_se, 0.0)


@pytest.fixture(scope="module")
def point():
    options = Options(impulse_s=150.0, segment_s=200.0)
    return identify(flown(5, 4000, 0.02), options).points[0]


def test_identify_recommends_the_subspace_model_over_ho_kalman(point):
    found = point.subspace
    assert found.order == 4
    assert found.trusted
    assert point.recommended is found.plant
    np.testing.assert_array_equal(found.response.freq_hz, point.freq_hz)
    true = truth(point.freq_hz)
    off = np.abs(found.response.H - true) / found.response.standard_deviation
    # 180 frequencies with 4 entries depend on about 24 numbers: no error reaches 4 deviations.
    assert off.max() < 4.0
    # The held-out data have noise of 0.02 on outputs of about 0.5.
    assert min(h.simulated_fit_percent.max() for h in found.holdout) > 90.0
    signals = SignalNames(("a", "b"), ("N", "N"), ("c", "d"), ("m", "m"), 1.0)
    text = summary(IdentificationResult(signals, (point,)))["points"][0]
    assert text["recommended"] == "subspace"
    assert text["subspace"]["modes"][0]["frequency_se_hz"] == found.modes.frequency_se_hz[0]
    assert len(text["subspace"]["response"]["magnitude_se"]) == 30
