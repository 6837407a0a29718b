"""Test Ho-Kalman realisation: exact Markov parameters give the original system, of any size."""

from __future__ import annotations

import numpy as np
import pytest

from levid.identification.nonparametric.markov_parameters import MarkovEstimate, convolve
from levid.identification.records.record import IdentificationError, Record
from levid.identification.subspace.hankel_operator import (
    HankelOperator,
    largest_singular_value,
    leading_svd,
)
from levid.identification.subspace.ho_kalman import (
    Scaling,
    decompose,
    decompose_coloured,
    noise_level,
    realise,
)


def _system(n: int, m: int, p: int, seed: int):
    """Return a stable random system with well-spread poles: A, B, C, D."""
    rng = np.random.default_rng(seed)
    A = np.diag(rng.uniform(0.5, 0.9, n) * rng.choice([-1, 1], n))
    Q = np.linalg.qr(rng.normal(size=(n, n)))[0]
    return Q @ A @ Q.T, rng.normal(size=(n, p)), rng.normal(size=(m, n)), rng.normal(size=(m, p))


def _markov(A, B, C, D, length: int) -> np.ndarray:
    g, x = [D], B
    for _ in range(length - 1):
        g.append(C @ x)
        x = A @ x
    return np.array(g)


@pytest.mark.parametrize("n", [1, 2, 3, 5])
@pytest.mark.parametrize(("m", "p"), [(1, 1), (1, 3), (3, 1), (2, 2), (3, 3), (4, 2)])
def test_exact_markov_parameters_give_back_the_system(n, m, p):
    g = _markov(*_system(n, m, p, seed=n + 10 * m + 100 * p), 61)
    # Units of very different size: the scaling must cancel.
    scaling = Scaling(np.logspace(-4, 2, m), np.logspace(1, -1, p))
    decomposition = decompose(g, 0.01, scaling)
    assert decomposition.orders == n
    model = realise(decomposition, n)
    found = _markov(model.A, model.B, model.C, model.D, 61)
    # Singular values of the random systems differ by up to 1e5; with rounding, 1e-6 is safe.
    np.testing.assert_allclose(found, g, atol=1e-6 * np.abs(g).max())


def test_hankel_operator_equals_the_dense_matrix():
    rng = np.random.default_rng(0)
    h = rng.normal(size=(60, 2, 3))
    operator = HankelOperator(h, 40, 20)
    dense = operator.dense()
    assert dense[2 * 5 + 1, 3 * 7 + 2] == h[5 + 7, 1, 2]
    x, y = rng.normal(size=60), rng.normal(size=80)
    # FFTs of length 60 round to about 1e-15 of the largest number.
    np.testing.assert_allclose(operator.matvec(x), dense @ x, atol=1e-13)
    np.testing.assert_allclose(operator.rmatvec(y), dense.T @ y, atol=1e-13)
    X = rng.normal(size=(60, 4))
    np.testing.assert_allclose(operator.matmat(X), dense @ X, atol=1e-13)


def test_leading_singular_triplets_equal_those_of_the_dense_matrix():
    rng = np.random.default_rng(1)
    t = np.arange(600)[:, None, None]
    h = np.exp(-t / 80.0) * np.cos(t * np.array([0.1, 0.3])[:, None] * np.array([1.0, 0.7]))
    h = h + 1e-4 * rng.normal(size=h.shape)
    operator = HankelOperator(h, 300, 300)  # side 600: beyond DENSE_SIDE, so Lanczos
    found = leading_svd(operator, 12)
    U, s, _ = np.linalg.svd(operator.dense())
    np.testing.assert_allclose(found.s, s[:12], rtol=1e-10)
    # Singular vectors are unique up to sign if their singular values differ.
    ratio = (s[:11] - s[1:12]) / s[0] > 1e-3
    overlap = np.abs(np.sum(found.U[:, :11] * U[:, :11], axis=0))
    np.testing.assert_allclose(overlap[ratio], 1.0, atol=1e-9)
    np.testing.assert_allclose(leading_svd(operator, 12).s, found.s, rtol=0, atol=0)


def test_largest_singular_value_of_noise_is_that_of_the_dense_matrix():
    noise = HankelOperator(np.random.default_rng(0).normal(size=(600, 3, 3)), 300, 300)
    exact = np.linalg.svd(noise.dense(), compute_uv=False)[0]
    assert 0.98 * exact < largest_singular_value(noise) <= exact * (1 + 1e-12)
    # Of a matrix with few singular values it is exact.
    h = _markov(*_system(3, 2, 2, seed=5), 201)
    few = HankelOperator(h, 100, 100)
    exact = np.linalg.svd(few.dense(), compute_uv=False)[0]
    assert largest_singular_value(few) == pytest.approx(exact, rel=1e-9)


def test_weighting_by_coloured_inputs_leaves_exact_data_exact():
    rng = np.random.default_rng(2)
    g = _markov(*_system(4, 2, 2, seed=5), 41)
    inputs = np.cumsum(rng.normal(size=(3000, 2)), axis=0) * 0.05 + rng.normal(size=(3000, 2))
    model = realise(decompose_coloured(g, 1.0, Scaling(np.ones(2), np.ones(2)), [inputs]), 4)
    found = _markov(model.A, model.B, model.C, model.D, 41)
    np.testing.assert_allclose(found, g, atol=1e-7 * np.abs(g).max())


def test_noise_level_separates_states_from_noise():
    C, unit = np.array([[1.0, 1.0, 0.3], [0.5, -1.0, 1.0]]), Scaling(np.ones(2), np.ones(2))
    g = _markov(np.diag([0.9, 0.8, -0.7]), C.T, C, np.zeros((2, 2)), 201)
    error = np.full((2, 2), 0.01)
    for seed in range(10):
        rng = np.random.default_rng([seed, 1])
        noisy = g + error * rng.normal(size=g.shape)
        markov = MarkovEstimate("least_squares", noisy, error, np.zeros(2), 1.0)
        v, noise = rng.normal(size=(2, 5000, 2))
        record = Record("r", 1.0, v, convolve(v, g) + noise, *[("a", "b")] * 4, at_rest=True)
        level = noise_level(markov, [record], lambda x: x, unit)
        assert np.sum(decompose(noisy, 1.0, unit).singular_values > level) == 3


def test_order_above_the_number_of_states_is_rejected():
    g = _markov(*_system(2, 1, 1, seed=1), 21)
    decomposition = decompose(g, 1.0, Scaling(np.ones(1), np.ones(1)))
    with pytest.raises(IdentificationError, match="expected an order of 1 to 2, found 5"):
        realise(decomposition, 5)


def test_too_few_markov_parameters_for_the_blocks_are_rejected():
    with pytest.raises(ValueError, match="expected at least 9 Markov parameters"):
        HankelOperator(np.zeros((5, 1, 1)), 5, 5)
