"""Test standard errors of the subspace method: coverage in a closed loop over many seeds."""

from __future__ import annotations

import numpy as np
import pytest

from levid.identification.closed_loop_subspace import add_subspace_model
from levid.identification.identify import identify
from levid.identification.options import Options
from levid.identification.records.record import PiController, Record
from levid.identification.records.signal_names import SignalNames
from levid.identification.results import IdentificationResult
from levid.identification.results_to_json import summary
from levid.identification.subspace import pbsid, pbsid_covariance
from levid.identification.subspace.pbsid import plant_by_subspace
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


def coverage(seeds: range, rows: int, past: int, noisier: float = 1.0) -> dict[str, float]:
    """Return the share of 95 % intervals that contain the truth, over entries and seeds."""
    true = truth(FREQ_HZ)
    poles = np.log(np.linalg.eigvals(A).astype(complex))
    poles = poles[poles.imag > 0]
    poles = poles[np.argsort(np.abs(poles))]
    held: dict[str, list[float]] = {"magnitude": [], "phase": [], "modes": []}
    for seed in seeds:
        found = plant_by_subspace(flown(seed, rows, 0.1 / noisier, noisier), 4, past=past)
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


# 60 seeds with about 8 independent numbers each: two standard deviations of 95 % are 2 %.
def test_confidence_intervals_have_95_percent_coverage():
    share = coverage(range(60), 1200, 20)
    for name, value in share.items():
        assert 0.92 <= value <= 0.98, (name, share)


def test_coverage_holds_for_records_with_different_noise():
    share = coverage(range(60), 1200, 20, noisier=5.0)
    for name, value in share.items():
        assert 0.92 <= value <= 0.98, (name, share)


def test_coverage_of_short_records_is_slightly_too_low():
    share = coverage(range(60), 400, 20)
    for name, value in share.items():
        # The first-order covariance of 82 parameters from 760 rows gives 93 to 94 %, minus 2 %.
        assert 0.91 <= value <= 0.98, (name, share)


def test_standard_errors_fall_with_the_root_of_the_length():
    def size(rows):
        found = plant_by_subspace(flown(1, rows, 0.1), 4, past=20)
        return response_with_errors(found.plant, found.covariance, FREQ_HZ).standard_deviation

    # 40 blocks per record determine each value to 10 %, their mean over frequencies to 5 %.
    assert np.mean(size(800) / size(7200)) == pytest.approx(3.0, rel=0.25)


def test_slope_is_the_derivative_with_respect_to_predictor_coefficients():
    """Perturb products of innovation and past in the Gram matrix, and identify again."""
    seen = [pbsid._core_signals(r, 0.0) for r in flown(2, 20_000, 0.01)]
    z = [np.hstack([r.v, r.y]) for r in seen]
    past, p = 12, 2
    gram = np.sum(pbsid.grams_of_lags(z, past), axis=0)

    def response(G):
        predictor = pbsid._predictor(G, p, 4)
        states = pbsid._states(G, predictor, p)[1].first(4)
        ABCD = pbsid._state_equations(G, states.of_past, p, 2)
        core = StateSpace(ABCD[:4, :4], ABCD[:4, 4:], ABCD[4:, :4], ABCD[4:, 4:], 1.0)
        return core.response(FREQ_HZ), predictor, states, ABCD

    P, predictor, states, ABCD = response(gram)
    slope = pbsid_covariance._slope(gram, predictor.theta, states, ABCD)
    regressors = np.concatenate([np.arange(4, len(gram)), np.arange(p)])
    rng = np.random.default_rng(0)
    normal = gram[np.ix_(regressors, regressors)]
    # The size of an innovation of 1e-6.
    products = 1e-6 * rng.normal(size=(2, len(regressors))) @ np.linalg.cholesky(normal).T
    perturbed = gram.copy()
    perturbed[np.ix_([2, 3], regressors)] += products
    perturbed[np.ix_(regressors, [2, 3])] += products.T
    theta = products @ np.linalg.inv(normal)
    change = np.einsum("abiq,iq->ab", slope, theta)
    inverse = np.linalg.inv(np.exp(2j * np.pi * FREQ_HZ)[:, None, None] * np.eye(4) - ABCD[:4, :4])
    ones = np.broadcast_to(np.eye(2), (len(FREQ_HZ), 2, 2))
    expected = (
        np.concatenate([ABCD[4:, :4] @ inverse, ones], axis=2)
        @ change
        @ np.concatenate([inverse @ ABCD[:4, 4:], ones], axis=1)
    )
    difference = response(perturbed)[0] - P
    # The slope ignores errors of the states: a tenth here, and less with less noise.
    assert np.abs(difference - expected).max() < 0.2 * np.abs(difference).max()


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
    assert found.order.order == 4
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


def test_records_too_short_for_a_subspace_model_give_a_remark(point):
    short = [r.rows(0, 60) for r in flown(5, 4000, 0.02)]
    without = add_subspace_model(point, short, Options())
    assert without.subspace is None
    assert any(r.startswith("no subspace model: a predictor with") for r in without.remarks)
