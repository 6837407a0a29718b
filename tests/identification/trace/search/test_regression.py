"""Test the regression on columns: least squares, cross-validation, significance."""

import numpy as np
import pytest

from levid.identification.trace.linearised.gram_matrices import Beside, Linearised
from levid.identification.trace.search.regression import (
    FOLDS,
    ColumnEvidence,
    covariance,
    cross_validated,
    foretold,
    foretold_between,
    gains,
    remaining,
    solve,
    standard_errors,
)

BLOCKS, ROWS, COLUMNS = 15, 60, 4
NO_PRIOR = np.zeros((0, 1))


def draw(seed: int, effect: float = 0.0, noise: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    """Return columns (blocks, rows, Q - 1) and errors (blocks, rows), -effect times column 2."""
    rng = np.random.default_rng(seed)
    X = rng.normal(size=(BLOCKS, ROWS, COLUMNS))
    X[:, :, 1] += 0.5 * X[:, :, 2]  # column 1 correlates with the candidate's column 2
    e = noise * rng.normal(size=(BLOCKS, ROWS)) - effect * X[:, :, 2]
    return X, e


def gram(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    return np.einsum("bri,brj->bij", one, other)


def linearised(X: np.ndarray, e: np.ndarray, base: int = COLUMNS) -> Linearised:
    """Return a record in the form of `linearise`; columns from `base` on are candidates."""
    squares = np.sum(X**2, axis=(0, 1))
    size = np.where(squares > 0, np.sqrt(squares), 1.0)
    wide = np.concatenate([X[:, :, :base] / size[:base], e[:, :, None]], axis=2)
    others = [(X[:, :, j : j + 1] / size[j], size[j : j + 1]) for j in range(base, COLUMNS)]
    return Linearised(
        "made", gram(wide, wide), np.append(size[:base], 1.0),
        np.full(len(X), float(X.shape[1])), np.arange(len(X), dtype=float),
        tuple(Beside(gram(wide, x), gram(x, x), own) for x, own in others),
    )  # fmt: skip


def evidence(
    X: np.ndarray, e: np.ndarray, prior: np.ndarray = NO_PRIOR, base: int = COLUMNS
) -> ColumnEvidence:
    return ColumnEvidence.gather([linearised(X, e, base)], prior)


def test_coefficients_are_those_of_least_squares() -> None:
    X, e = draw(1, 0.3)
    found = evidence(X, e)
    coefficients = solve(found.whole, range(COLUMNS)) / found.size[:-1]
    flat = X.reshape(-1, COLUMNS)
    wanted = np.linalg.lstsq(flat, -e.reshape(-1), rcond=None)[0]
    # The ridge is 1e-11 of the squares of the columns; the rest is rounding of normal equations.
    np.testing.assert_allclose(coefficients, wanted, rtol=1e-8, atol=1e-10)
    spread = covariance(found.whole, range(COLUMNS)) / np.outer(found.size[:-1], found.size[:-1])
    np.testing.assert_allclose(spread, np.linalg.inv(flat.T @ flat), rtol=1e-8, atol=1e-10)


def test_remaining_error_is_the_sum_of_squares_per_block() -> None:
    X, e = draw(2, 0.3)
    found = evidence(X, e)
    chosen = [0, 2]
    coefficients = solve(found.whole, chosen)
    residual = e + X[:, :, chosen] @ (coefficients / found.size[chosen])
    np.testing.assert_allclose(
        remaining(found.gram, chosen, coefficients),
        np.sum(residual**2, axis=1),
        rtol=1e-10,
    )


def test_each_block_is_validated_with_coefficients_of_the_other_folds() -> None:
    X, e = draw(3, 0.3)
    fold = np.arange(BLOCKS) % FOLDS
    expected = np.empty(BLOCKS)
    for k in range(FOLDS):
        fitted = X[fold != k].reshape(-1, COLUMNS)
        c = np.linalg.lstsq(fitted, -e[fold != k].reshape(-1), rcond=None)[0]
        expected[fold == k] = np.sum((e[fold == k] + X[fold == k] @ c) ** 2, axis=1)
    np.testing.assert_allclose(cross_validated(evidence(X, e), range(COLUMNS)), expected, rtol=1e-8)


def test_without_columns_the_errors_stay_the_same() -> None:
    X, e = draw(4)
    np.testing.assert_allclose(
        cross_validated(evidence(X, e), []), np.sum(e**2, axis=1), rtol=1e-12
    )


def test_joined_candidate_equals_a_column_from_the_start() -> None:
    X, e = draw(9, 0.3)
    row = np.array([[2.0, 0.0, 1.0]])
    whole, joined = evidence(X, e, row), evidence(X, e, row, COLUMNS - 1).joined(0)
    np.testing.assert_allclose(joined.gram, whole.gram, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(joined.size, whole.size, rtol=1e-12)
    np.testing.assert_allclose(joined.prior, whole.prior, rtol=1e-12)


def test_zero_column_has_no_gain() -> None:
    X, e = draw(5, 0.3)
    X[:, :, 3] = 0.0
    with np.errstate(all="raise", under="ignore"):
        there, nothing = gains(evidence(X, e, base=2))
    assert nothing.sum() == pytest.approx(0.0, abs=1e-6)
    assert there.sum() > 0.0


def test_gain_of_a_column_is_what_it_explains_and_an_idle_column_loses_little() -> None:
    X, e = draw(6, 0.3)
    there, idle = (found.sum() for found in gains(evidence(X, e, base=2)))
    # Column 2 orthogonal to column 1 has 1 / 1.25 of its square: 0.3^2 * 0.8 per row, 900 rows,
    # standard deviation 2 sqrt(65) = 16. An idle column loses about one, at most 15.
    assert there == pytest.approx(0.09 * 0.8 * BLOCKS * ROWS, abs=4 * 16)
    assert -15.0 < idle < 15.0


def test_gathered_records_equal_one_record() -> None:
    X, e = draw(7, 0.2)
    parts = [slice(0, 5), slice(5, BLOCKS)]
    lines = []
    for i, part in enumerate(parts):
        wide = np.concatenate([X[part], e[part, :, None]], axis=2)
        size = np.append(np.sqrt(np.sum(X[part] ** 2, axis=(0, 1))), 1.0)
        count, time_s = np.full(len(wide), float(ROWS)), np.arange(len(wide), dtype=float)
        scaled = gram(wide, wide) / size / size[:, None]
        lines.append(Linearised(str(i), scaled, size, count, time_s))
    both, one = ColumnEvidence.gather(lines, NO_PRIOR), evidence(X, e)
    both_physical = both.whole * both.size * both.size[:, None]
    one_physical = one.whole * one.size * one.size[:, None]
    np.testing.assert_allclose(both_physical, one_physical, rtol=1e-11, atol=1e-9)
    assert both.squares == pytest.approx(np.sum(e**2))
    assert both.excess == pytest.approx(np.sum(e**2) - e.size)
    np.testing.assert_array_equal(both.record, [0] * 5 + [1] * 10)


def test_prior_counts_as_one_more_row() -> None:
    X, e = draw(8, 0.2)
    row = np.array([[2.0, 0.0, 1.0]])  # for the first two columns: 2 c0 + 1 = 0
    found = evidence(X, e, row)
    coefficients = solve(found.whole, [0, 1]) / found.size[:2]
    flat = np.vstack([X[:, :, :2].reshape(-1, 2), row[:, :2]])
    target = np.append(e.reshape(-1), 1.0)
    wanted = np.linalg.lstsq(flat, -target, rcond=None)[0]
    np.testing.assert_allclose(coefficients, wanted, rtol=1e-8)
    assert found.squares == pytest.approx(np.sum(e**2))  # the prior is no error of a record


def agreement(seed: int, effect: float, noise: float) -> float:
    train, held = (evidence(*draw(2 * seed + i, effect, noise)) for i in (0, 1))
    pick = [0, 1, 2]
    there = solve(train.whole, pick) / train.size[pick] * held.size[pick]
    return foretold(held, [0, 1], [2], there).statistic


@pytest.mark.parametrize("noise", [1.0, 3.0])
def test_agreement_statistic_of_noise_is_standard_normal(noise: float) -> None:
    # The statistic is normalised by the actual errors, so it is the same for larger errors.
    found = np.array([agreement(seed, 0.0, noise) for seed in range(600)])
    # Mean and variance of 600 standard normal numbers: four standard deviations of each.
    assert abs(found.mean()) < 4 / np.sqrt(600)
    assert abs(found.var() - 1.0) < 4 * np.sqrt(2 / 600)
    # 0.27 % exceed three: 1.6 are expected, more than seven have a probability of 1 / 1500.
    assert np.sum(np.abs(found) > 3) <= 7


def draw_with_larger_errors(
    seed: int, effect: float = 0.0, noise: float = 3.0
) -> tuple[np.ndarray, np.ndarray]:
    """Return columns and errors of which 18 of 60 rows belong to a DOF with larger errors.

    The columns act on that DOF alone: non-rigid readings do not depend on forces.
    """
    X, e = draw(seed, effect)
    X[:, 18:] = 0.0
    e[:, 18:] = np.random.default_rng(10_000 + seed).normal(size=(BLOCKS, ROWS - 18))
    e[:, :18] += np.sqrt(noise**2 - 1) * np.random.default_rng(20_000 + seed).normal(
        size=(BLOCKS, 18)
    )
    return X, e


def test_agreement_uses_the_error_variance_where_the_candidate_acts() -> None:
    """With one variance for all rows, the statistic would have a variance of 9 / 3.4."""
    found = []
    for seed in range(600):
        train, held = (evidence(*draw_with_larger_errors(2 * seed + i)) for i in (0, 1))
        pick = [0, 1, 2]
        there = solve(train.whole, pick) / train.size[pick] * held.size[pick]
        found.append(foretold(held, [0, 1], [2], there).statistic)
    # The larger of two estimates is used, one of them from 15 blocks: up to a quarter below one.
    assert 0.7 < np.var(found) < 1.0 + 4 * np.sqrt(2 / 600)
    between = [
        foretold_between(evidence(*draw_with_larger_errors(s)), [0, 1], [2]).statistic
        for s in range(300)
    ]
    assert np.var(between) < 2.0 + 4 * np.sqrt(8 / 300)


@pytest.mark.parametrize("make", [draw, draw_with_larger_errors])
def test_standard_errors_agree_with_the_scatter_of_coefficients(make) -> None:
    pick, found, stated_errors = [0, 1, 2], [], []
    for seed in range(300):
        one_draw = evidence(*make(seed))
        found.append(solve(one_draw.whole, pick) / one_draw.size[pick])
        stated_errors.append(standard_errors(one_draw, pick))
    ratio = np.std(found, axis=0) / np.sqrt(np.mean(np.square(stated_errors), axis=0))
    # 300 values determine the scatter to 4 %; the larger of two estimates is about 10 % too large.
    assert np.all((ratio > 0.8) & (ratio < 1.1))


def test_standard_errors_count_what_differs_from_record_to_record() -> None:
    # An equation that is not exact: column 2 has another coefficient in each of six records.
    found, stated = [], []
    for seed in range(200):
        own = 0.3 * np.random.default_rng(30_000 + seed).normal(size=6)
        records = [linearised(*draw(1000 * seed + i, d)) for i, d in enumerate(own)]
        together = ColumnEvidence.gather(records, NO_PRIOR)
        found.append(solve(together.whole, range(COLUMNS))[2] / together.size[2])
        stated.append(standard_errors(together, range(COLUMNS))[2])
    # Blocks alone would state 0.4 of the scatter. That of six records is 9 % too small by itself.
    ratio = np.std(found) / np.sqrt(np.mean(np.square(stated)))
    assert 0.8 < ratio < 1.2


def test_overestimated_noise_does_not_increase_the_agreement() -> None:
    # The assumed standard deviation of errors is never below one.
    found = np.array([agreement(seed, 0.0, 0.3) for seed in range(300)])
    assert found.std() == pytest.approx(0.3, rel=4 / np.sqrt(600))


def test_agreement_is_proportional_to_the_effect() -> None:
    weak, strong = (
        np.mean([agreement(seed, effect, 1.0) for seed in range(40)]) for effect in (0.2, 0.6)
    )
    # Signal over noise is effect sqrt(0.8 * 900), a mean of 40 is known to 0.16; for weak effects
    # errors of the coefficients lower it slightly.
    assert strong == pytest.approx(0.6 * np.sqrt(720), rel=0.1)
    assert weak == pytest.approx(0.2 * np.sqrt(720), rel=0.1)


def test_agreement_equals_its_expected_value_for_white_residuals() -> None:
    sizes = []
    for seed in range(100):
        train, held = (evidence(*draw(2 * seed + i, 0.3)) for i in (0, 1))
        pick = [0, 1, 2]
        there = solve(train.whole, pick) / train.size[pick] * held.size[pick]
        sizes.append(foretold(held, [0, 1], [2], there))
    difference = np.array([found - wanted for found, wanted in sizes])
    # The error of the coefficients lowers the statistic by half a variance over its size: 0.07.
    assert abs(difference.mean()) < 4 / np.sqrt(100) + 0.07
    assert foretold(held, [0, 1], [2], np.zeros(3)) == (0.0, 0.0)


def between(seed: int, effect: float = 0.0) -> float:
    return foretold_between(evidence(*draw(seed, effect)), [0, 1], [2]).statistic


def test_agreement_between_blocks_is_found_for_an_effect_and_not_for_noise() -> None:
    nothing = np.array([between(s) for s in range(600)])
    # Without an effect, folds predict each other with the opposite sign: the mean is below zero.
    assert nothing.mean() < 4 * np.sqrt(2 / 600)
    # Products of noise have longer tails than noise; 600 normal values of variance two reach 4.5.
    assert nothing.max() < 8.0
    for effect in (0.3, 0.6):
        there = [between(s, effect) for s in range(20)]
        # As large as in other records of the same length: 0.3 sqrt(0.8 900) = 8.
        assert np.mean(there) == pytest.approx(effect * np.sqrt(0.8 * BLOCKS * ROWS), rel=0.15)


def test_effect_in_a_few_blocks_is_found() -> None:
    X, e = draw(3, 0.0)
    X[:, :, 2] = 0.0
    X[4:7, :, 2] = np.random.default_rng(1).normal(size=(3, ROWS))
    e[4:7] -= 2.0 * X[4:7, :, 2]
    assert foretold_between(evidence(X, e), [0, 1], [2]).statistic > 15.0


@pytest.mark.parametrize(("present", "lowers"), [(1.0, True), (0.6, True), (0.4, False)])
def test_prediction_lowers_the_errors_if_more_than_half_of_it_is_there(
    present: float, lowers: bool
) -> None:
    train, held = evidence(*draw(1, 0.9)), evidence(*draw(2, 0.9 * present))
    pick = [0, 1, 2]
    there = solve(train.whole, pick) / train.size[pick] * held.size[pick]
    found = foretold(held, [0, 1], [2], there)
    assert (found.statistic > 0.5 * found.expected) is lowers
    # The records may have other parameters of their own: these are regressed in both.
    base, errors = [0, 1], held.whole
    take = np.eye(len(errors))
    take[2, -1] = there[2]
    squares = [
        remaining(g[None], base, solve(g, base))[0] for g in (errors, take.T @ errors @ take)
    ]
    assert bool(squares[1] < squares[0]) is lowers
