"""Test frequency responses: eq. (15) is exact, and intervals have the stated coverage."""

from __future__ import annotations

import numpy as np
import pytest

from levid.identification.nonparametric import frequency_response
from levid.identification.nonparametric.markov_parameters import convolve, markov_response
from levid.identification.records.record import IdentificationError, PiController, Record

TS = 0.01
FREQ = np.geomspace(0.5, 40.0, 40)


def _exact(rig, x_b_m: float, Ts_s: float, freq_hz: np.ndarray):
    controller = PiController(rig.KP, rig.KI)
    P = rig.sampled_plant(x_b_m, Ts_s).frequency_response(freq_hz)
    C = controller.response(freq_hz, Ts_s)
    S = np.linalg.inv(np.eye(3) + C[:, :, None] * P)
    return P, S, controller


def test_controller_response_is_that_of_the_discrete_controller(rig):
    controller = PiController(rig.KP, rig.KI)
    # The impulse response of C is kp + ki Ts, ki Ts, ki Ts, ...; compare its z-transform.
    found = controller.response(np.array([0.0, 7.0]), 1e-3)
    z = np.exp(2j * np.pi * 7.0 * 1e-3)
    np.testing.assert_allclose(found[1], rig.KP + rig.KI * 1e-3 * z / (z - 1), rtol=1e-14)
    assert not np.any(np.isfinite(found[0]))


@pytest.mark.parametrize("x_b_m", [-0.1, 0.0, 0.1])
def test_equation_15_is_exact_for_the_exact_sensitivity(rig, x_b_m):
    freq = np.geomspace(0.01, 400.0, 50)  # S goes from 0.06 to 1 - 4e-5
    P, S, controller = _exact(rig, x_b_m, 1e-3, freq)
    estimate = frequency_response.ResponseEstimate(
        freq, S, np.ones((50, 3, 3)), np.zeros((50, 3, 3, 3, 3), complex), 1e-3
    )
    found = frequency_response.plant_from_sensitivity(estimate, controller)
    # S is rounded to 1e-16 and I - S is as small as 4e-5, so the diagonal is exact to 1e-11.
    diagonal = np.abs(np.einsum("fii->fi", P))
    size = np.sqrt(diagonal[:, :, None] * diagonal[:, None, :])
    assert np.abs((found.H - P) / size).max() < 1e-9


def _mimo(seed: int, rows: int, *, one_at_a_time: bool, noise: float):
    """Return records (v, y) of a 2 x 2 FIR system with noise, and the system."""
    rng = np.random.default_rng(seed)
    g = rng.normal(size=(20, 2, 2)) * 0.8 ** np.arange(20)[:, None, None]
    inputs, outputs = [], []
    for j in range(2):
        v = rng.normal(size=(rows, 2))
        if one_at_a_time:
            v[:, 1 - j] = 0.0
        inputs.append(v)
        outputs.append(convolve(v, g) + noise * rng.normal(size=(rows, 2)))
    return inputs, outputs, g


@pytest.mark.parametrize("one_at_a_time", [True, False])
def test_confidence_intervals_have_95_percent_coverage(one_at_a_time):
    inside = []
    for seed in range(20):
        inputs, outputs, g = _mimo(seed, 6000, one_at_a_time=one_at_a_time, noise=0.5)
        found = frequency_response.frequency_response(inputs, outputs, TS, FREQ, 4.0)
        error = np.abs(found.H - markov_response(g, found.freq_hz, TS))
        inside.append(error < np.sqrt(-np.log(0.05)) * found.standard_deviation)
    # 20 x 31 x 4 complex errors, half of them independent: the coverage is known to 2 %.
    assert np.mean(inside) == pytest.approx(0.95, abs=0.02)


@pytest.mark.parametrize("segments", [3, 5])
@pytest.mark.parametrize("one_at_a_time", [True, False])
def test_coverage_holds_with_few_segments(segments, one_at_a_time):
    length = 200
    inside = []
    for seed in range(100):
        rng = np.random.default_rng(seed)
        v = rng.normal(size=(3, (segments + 1) * length // 2, 3))
        if one_at_a_time:
            v *= np.eye(3)[:, None]
        y = rng.normal(size=(3, v.shape[1], 2))  # the true response is zero
        found = frequency_response.frequency_response(list(v), list(y), TS, FREQ, length * TS)
        size = np.abs(found.H)
        inside.append(size < np.sqrt(-np.log(0.05)) * found.standard_deviation)
    # 100 x 28 x 6 errors, half of them independent, scatter by 0.3 %; three of that, and 1 % as the
    # degrees of freedom of overlapping segments and unequal records are approximate.
    assert np.mean(inside) == pytest.approx(0.955, abs=0.015)


@pytest.mark.parametrize("segments", [8, 30])
def test_coverage_holds_for_periodic_inputs(segments):
    """With equal inputs in all segments, the noise in overlapping parts adds up."""
    length = 200
    inside = []
    for seed in range(100):
        rng = np.random.default_rng(seed)
        period = rng.normal(size=(length // 2, 1))
        v = np.tile(period, (segments + 1, 1))
        y = rng.normal(size=v.shape)
        every_second = np.arange(2, 60, 2) / (length * TS)
        found = frequency_response.frequency_response([v], [y], TS, every_second, length * TS)
        inside.append(np.abs(found.H) < np.sqrt(-np.log(0.05)) * found.standard_deviation)
    # 2900 errors scatter by 0.4 %; three of that. With the count for white inputs it is 91 %.
    assert np.mean(inside) == pytest.approx(0.95, abs=0.012)


@pytest.mark.parametrize("noise", [0.0, 0.3, 100.0])
def test_coherence_lies_between_0_and_1_and_falls_with_noise(noise):
    inputs, outputs, _ = _mimo(1, 6000, one_at_a_time=True, noise=noise)
    found = frequency_response.frequency_response(inputs, outputs, TS, FREQ, 4.0)
    assert found.coherence.min() >= 0.0
    assert found.coherence.max() <= 1.0
    expected = {0.0: (0.97, 1.0), 0.3: (0.8, 0.999), 100.0: (0.0, 0.2)}[noise]
    assert expected[0] <= np.median(found.coherence) <= expected[1]


def test_frequencies_are_unique_bins_of_the_segments():
    inputs, outputs, _ = _mimo(2, 3000, one_at_a_time=True, noise=0.0)
    found = frequency_response.frequency_response(inputs, outputs, TS, FREQ, 4.0)
    np.testing.assert_allclose(found.freq_hz * 4.0, np.rint(found.freq_hz * 4.0), atol=1e-9)
    assert np.all(np.diff(found.freq_hz) > 0)
    assert found.H.shape == (len(found.freq_hz), 2, 2)


def test_joint_and_sensitivity_estimates_agree_with_a_known_controller(rig):
    records = rig.records([0.0], 1000.0, 20.0, seed=3)
    grid = np.geomspace(2.0, 64.0, 30)
    controller = PiController(rig.KP, rig.KI)
    ours = frequency_response.plant_from_sensitivity(
        frequency_response.sensitivity(records, grid, 8.0), controller
    )
    joint = frequency_response.plant_from_joint(records, grid, 8.0)
    # They differ only by leakage of the integrators' states, far less than their errors.
    for i in range(3):
        ratio = joint.H[:, i, i] / ours.H[:, i, i]
        assert np.abs(ratio - 1).max() < 0.05


def test_records_that_do_not_determine_the_response_are_rejected():
    v = np.random.default_rng(0).normal(size=(1000, 1))
    with pytest.raises(IdentificationError, match="at least two segments of 8 s, found a record"):
        frequency_response.frequency_response([v], [v], TS, FREQ, 8.0)
    with pytest.raises(IdentificationError, match="independent inputs"):
        frequency_response.frequency_response([np.hstack([v, v])], [v], TS, FREQ, 2.0)
    three = np.random.default_rng(1).normal(size=(1000, 3))
    with pytest.raises(IdentificationError, match=r"more segments of 5 s than the 3 inputs, found"):
        frequency_response.frequency_response([three], [v], TS, FREQ, 5.0)
    silent = np.hstack([v, 0 * v])
    with pytest.raises(IdentificationError, match="every input to be excited"):
        frequency_response.frequency_response([silent], [v], TS, FREQ, 2.0)
    record = Record("r", TS, v, v, ("a",), ("1",), ("b",), ("1",))
    with pytest.raises(IdentificationError, match="'r': expected the plant input u"):
        frequency_response.sensitivity([record], FREQ, 2.0)
