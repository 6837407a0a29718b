"""Test Markov parameters: FFT and least squares agree, and standard errors are correct."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import toeplitz as toeplitz_matrix
from scipy.signal import butter, sosfilt

from levid.identification.nonparametric import markov_parameters, toeplitz_least_squares
from levid.identification.records.record import IdentificationError, Record


def _record(v: np.ndarray, y: np.ndarray, *, at_rest: bool, name: str = "r") -> Record:
    inputs = tuple(f"u{j}" for j in range(v.shape[1]))
    outputs = tuple(f"y{i}" for i in range(y.shape[1]))
    return Record(
        name, 1e-3, v, y, inputs, ("1",) * len(inputs), outputs, ("1",) * len(outputs),
        at_rest=at_rest,
    )  # fmt: skip


def _explicit(records: list[Record], taps: int) -> tuple[np.ndarray, np.ndarray]:
    """Solve with the explicit Toeplitz matrix: g (L, m, p) and the diagonal of its covariance."""
    rows, targets = [], []
    for number, record in enumerate(records):
        n, p = record.v.shape
        T = np.hstack([toeplitz_matrix(record.v[:, j], np.zeros(taps)) for j in range(p)])
        offset = np.zeros((n, len(records)))
        offset[:, number] = 1.0
        rows.append(np.hstack([T, offset])[record.first_row(taps) :])
        targets.append(record.y[record.first_row(taps) :])
    X, Y = np.vstack(rows), np.vstack(targets)
    theta = np.linalg.lstsq(X, Y, rcond=None)[0][: p * taps]
    variance = np.diag(np.linalg.inv(X.T @ X))[: p * taps]
    return theta.reshape(p, taps, -1).transpose(1, 2, 0), variance.reshape(p, taps)


@pytest.mark.parametrize("at_rest", [True, False])
@pytest.mark.parametrize(("p", "m"), [(1, 1), (2, 3), (3, 2)])
def test_fft_solution_equals_least_squares_on_the_explicit_matrix(at_rest, p, m):
    rng = np.random.default_rng(p)
    # Coloured, correlated inputs in two records of different lengths and offsets.
    records = []
    for rows in (90, 140):
        v = 0.3 * np.cumsum(rng.normal(size=(rows, p)), axis=0) + rng.normal(size=(rows, p))
        y = rng.normal(size=(rows, m)) + rng.normal(size=m)
        records.append(_record(v, y, at_rest=at_rest))
    taps = 12
    expected, _ = _explicit(records, taps)
    gram = toeplitz_least_squares.ToeplitzGram.from_records(records, taps)
    by_fft = toeplitz_least_squares.solve(gram, gram.right_hand_side([r.y for r in records]))
    by_qr, _ = markov_parameters.solve_dense(records, taps)
    # Condition numbers are below 100, so any algorithm is exact to 1e-12.
    np.testing.assert_allclose(by_fft, expected, atol=1e-12 * np.abs(expected).max())
    np.testing.assert_allclose(by_qr, expected, atol=1e-12 * np.abs(expected).max())


def test_records_that_each_excite_one_input_are_solved_together():
    rng = np.random.default_rng(1)
    g = rng.normal(size=(15, 2, 2))
    records = []
    for j in range(2):
        v = np.zeros((400, 2))
        v[:, j] = rng.normal(size=400)
        records.append(_record(v, markov_parameters.convolve(v, g) + 3.0, at_rest=True))
    gram = toeplitz_least_squares.ToeplitzGram.from_records(records, 15)
    found = toeplitz_least_squares.solve(gram, gram.right_hand_side([r.y for r in records]))
    # Exact data, so only rounding is left; the offset of 3 is estimated as well.
    np.testing.assert_allclose(found, g, atol=1e-11)


def test_circulant_approximation_of_standard_errors_is_accurate():
    rng = np.random.default_rng(2)
    records = [_record(rng.normal(size=(2000, 2)), rng.normal(size=(2000, 1)), at_rest=True)]
    _, variance = _explicit(records, 100)
    gram = toeplitz_least_squares.ToeplitzGram.from_records(records, 100)
    # The circulant approximation ignores the ends of the record: L / N = 5 %.
    np.testing.assert_allclose(gram.inverse_scale(), np.sqrt(variance.mean(axis=1)), rtol=0.05)


@pytest.mark.parametrize("method", sorted(markov_parameters.ESTIMATORS))
def test_errors_agree_with_the_standard_error(method):
    rng = np.random.default_rng(3)
    t = np.arange(200)
    g = np.exp(-t / 30.0)[:, None, None] * np.sin(t / 5.0)[:, None, None] * np.ones((200, 1, 1))
    v = rng.normal(size=(20_000, 1))
    y = markov_parameters.convolve(v, g) + 0.5 * rng.normal(size=(20_000, 1))
    found = markov_parameters.estimate_markov([_record(v, y, at_rest=True)], 200, method)
    ratio = np.sqrt(np.mean((found.g - g) ** 2)) / found.standard_error[0, 0]
    # 200 taps determine the rms to 5 %; with method correlation, errors of about 30 neighbouring
    # taps are correlated, hence 30 %.
    assert ratio == pytest.approx(1.0, abs=0.3)


def test_correlation_is_unbiased_at_taps_near_the_record_length():
    rows, length, tap, seeds = 400, 300, 100, 200
    g = np.zeros((length, 1, 1))
    g[tap] = 1.0
    found, ratios = [], []
    for seed in range(seeds):
        v = np.random.default_rng(seed).normal(size=(rows, 1))
        record = _record(v, markov_parameters.convolve(v, g), at_rest=True)
        estimate = markov_parameters.estimate_markov([record], length, "correlation")
        found.append(estimate.g[tap, 0, 0])
        others = np.delete(estimate.g[:, 0, 0], tap)
        ratios.append(np.mean(others**2) / estimate.standard_error[0, 0] ** 2)
    # There is no noise. Subtracting the mean of the output removes 1 / N of the tap. Divided by
    # the power of all rows, the estimate would be 0.75.
    assert np.mean(found) == pytest.approx(1.0, abs=0.01)
    # 200 x 299 independent squares determine the mean to 1 %; five times that, because the last
    # taps are ratios over as few as 100 rows.
    assert np.mean(ratios) == pytest.approx(1.0, abs=0.05)


@pytest.mark.parametrize("together", [False, True])
def test_predicted_deviation_of_correlation_is_its_spread_over_seeds(together):
    rows, length, seeds, noise = 3000, 80, 800, 0.3
    t = np.arange(length)[:, None, None]
    # Decayed to 1e-3 at the end; two outputs that respond unequally to two inputs.
    g = np.exp(-t / 12.0) * np.sin(t * np.array([[0.5, 0.3], [0.9, 0.4]]))
    g *= np.array([[1.0, 0.2], [0.1, 3.0]])
    errors = np.empty((seeds, length, 2, 2))
    for seed in range(seeds):
        rng = np.random.default_rng(seed)
        v = rng.normal(size=(rows + length, 2)) * [1.0, 0.5]
        inputs = [v] if together else [v * [1, 0], v * [0, 1]]
        records = []
        for alone in inputs:  # the first rows are cut off: y is stationary from the start
            y = markov_parameters.convolve(alone, g)[length:]
            y += noise * rng.normal(size=y.shape)
            records.append(_record(alone[length:], y, at_rest=False))
        errors[seed] = markov_parameters.estimate_markov(records, length, "correlation").g - g
    response = (g**2).sum(axis=0) * [1.0, 0.25]  # power of each output from each input
    if together:
        response = np.repeat(response.sum(axis=1, keepdims=True), 2, axis=1)
    predicted = markov_parameters.correlation_standard_deviation(
        g, np.sqrt(response + noise**2), np.array([1.0, 0.5]), rows
    )
    ratio = errors.std(axis=0) / predicted
    # 800 seeds determine a standard deviation to 1 / sqrt(1600) = 2.5 %: five of these for the
    # worst of 320. The formula neglects the length of the response, 12 of 3000 rows.
    np.testing.assert_allclose(ratio, 1.0, atol=0.125)
    # Errors of some ten neighbouring taps are correlated, so the mean of 80 taps is known to
    # 2.5 % / sqrt(8) = 0.9 %: three of these.
    np.testing.assert_allclose(np.sqrt((ratio**2).mean(axis=0)), 1.0, atol=0.03)
    # Without the two terms that depend on t, a tap's prediction would be wrong by up to a third.
    flat = np.sqrt(np.mean(predicted**2, axis=0))
    assert np.abs(predicted / flat - 1.0).max() > 0.25


def test_correlation_of_an_excitation_that_begins_late_is_finite():
    v = np.zeros((400, 1))
    v[300:, 0] = np.random.default_rng(6).normal(size=100)
    found = markov_parameters.estimate_markov([_record(v, v, at_rest=True)], 200, "correlation")
    assert np.all(np.isfinite(found.g))
    assert np.all(np.isfinite(found.standard_error))
    # The record contains no response at delays of 100 rows and more.
    assert found.g[0, 0, 0] == pytest.approx(1.0, rel=0.05)
    assert np.all(found.g[100:] == 0.0)


def test_least_squares_has_no_self_noise():
    rng = np.random.default_rng(4)
    g = np.exp(-np.arange(100) / 20.0)[:, None, None]
    v = rng.normal(size=(5000, 1))
    record = _record(v, markov_parameters.convolve(v, g), at_rest=True)
    exact = markov_parameters.estimate_markov([record], 100, "least_squares")
    correlated = markov_parameters.estimate_markov([record], 100, "correlation")
    # Without noise the error of least squares is rounding; that of correlation is about
    # 1 / sqrt(N) of the energy.
    assert np.abs(exact.g - g).max() < 1e-11
    assert np.abs(correlated.g - g).max() > 0.01


def test_unknown_method_is_rejected_with_the_known_methods():
    record = _record(np.ones((10, 1)), np.ones((10, 1)), at_rest=True)
    with pytest.raises(IdentificationError, match=r"correlation, least_squares, found 'least'"):
        markov_parameters.estimate_markov([record], 3, "least")


def test_short_record_is_rejected_with_its_name():
    record = _record(np.ones((10, 1)), np.ones((10, 1)), at_rest=False, name="left-psi")
    with pytest.raises(IdentificationError, match="'left-psi': expected at least 12 rows"):
        markov_parameters.estimate_markov([record], 6, "least_squares")


@pytest.mark.parametrize("dense", [True, False])
def test_fewer_rows_than_unknowns_are_rejected(monkeypatch, dense):
    monkeypatch.setattr(markov_parameters, "DENSE_ELEMENTS", 10**9 if dense else 0)
    v = np.random.default_rng(5).normal(size=(420, 3))
    record = _record(v, v, at_rest=False)
    assert markov_parameters.most_taps([record]) == 60
    markov_parameters.estimate_markov([record], 60, "least_squares")
    # An iterative solution would fit the noise and give a standard error near zero.
    with pytest.raises(IdentificationError, match="expected at least 840 usable rows"):
        markov_parameters.estimate_markov([record], 140, "least_squares")
    alone = [_record(v * (np.arange(3) == j), v, at_rest=False) for j in range(3)]
    assert (
        markov_parameters.most_taps(alone) == 140
    )  # a third of each record, if each excites one input


def test_excitation_without_power_in_a_band_is_rejected():
    # An eighth-order low pass at a tenth of Nyquist leaves at most 1e-16 of the power above it.
    rng = np.random.default_rng(5)
    v = sosfilt(butter(8, 0.1, output="sos"), rng.normal(size=4000))[:, None]
    gram = toeplitz_least_squares.ToeplitzGram.from_records([_record(v, v, at_rest=True)], 200)
    with pytest.raises(IdentificationError, match="excitation does not determine"):
        toeplitz_least_squares.solve(gram, gram.right_hand_side([rng.normal(size=(4000, 1))]))


def test_taps_that_the_excitation_does_not_determine_are_rejected():
    v = np.sin(2 * np.pi * 0.1 * np.arange(4000))[:, None]  # one line determines two taps, not 50
    with pytest.raises(IdentificationError, match="excitation that determines 50"):
        markov_parameters.solve_dense([_record(v, v, at_rest=False)], 50)


def test_response_of_markov_parameters_is_their_z_transform():
    g = np.array([0.0, 1.0, 0.5])[:, None, None]
    z = np.exp(2j * np.pi * 3.0 * 0.01)
    found = markov_parameters.markov_response(g, np.array([3.0]), 0.01)
    np.testing.assert_allclose(found[0, 0, 0], 1 / z + 0.5 / z**2, rtol=1e-14)


@pytest.mark.parametrize("limit", [markov_parameters.DENSE_ELEMENTS, 0])
@pytest.mark.parametrize("method", sorted(markov_parameters.ESTIMATORS))
def test_nested_estimates_equal_estimates_of_each_length(monkeypatch, method, limit):
    monkeypatch.setattr(markov_parameters, "DENSE_ELEMENTS", limit)
    rng = np.random.default_rng(5)
    records = [
        _record(rng.normal(size=(rows, 2)), rng.normal(size=(rows, 3)), at_rest=True)
        for rows in (150, 200)
    ]
    found = markov_parameters.nested_estimates(records, (24, 12, 6), method)
    assert list(found) == [24, 12, 6]
    for length, g in found.items():
        alone = markov_parameters.estimate_markov(records, length, method).g
        # Conjugate gradients converge to 1e-8.
        np.testing.assert_allclose(g, alone, atol=1e-7 * np.abs(alone).max())


def test_nested_estimates_leave_out_lengths_that_a_sine_does_not_determine():
    t = np.arange(400.0)
    v = (np.sin(0.3 * t) + np.sin(1.1 * t))[:, None]
    record = _record(v, v.copy(), at_rest=False)
    assert list(markov_parameters.nested_estimates([record], (8, 4), "least_squares")) == [4]
