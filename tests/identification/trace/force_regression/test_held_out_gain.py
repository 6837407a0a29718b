"""Test what blocks gain that did not fit an effect."""

from __future__ import annotations

import numpy as np
import pytest

from levid.identification.trace.force_regression.held_out_gain import (
    Blocks,
    Columns,
    block_sums,
    bounded,
    error_of_mean,
    gain_of,
)

ROWS, COUNT = 2400, 24


def records(rng: np.random.Generator, amplitudes: tuple[float, ...]) -> tuple[list, list, list]:
    """Return model columns (1), an effect's column (1), and missing forces of two records."""
    base = [rng.normal(size=(1, ROWS, 1)) for _ in amplitudes]
    effect = [rng.normal(size=(1, ROWS, 1)) for _ in amplitudes]
    missing = [
        0.5 * b[0] + a * e[0] + rng.normal(size=(ROWS, 1))
        for a, b, e in zip(amplitudes, base, effect, strict=True)
    ]
    return base, effect, missing


def judged(columns: list, missing: list, blocks: Blocks) -> Columns:
    grams = blocks.grams(columns, missing)
    size = grams.shape[-1]
    power = np.zeros((1, size, size))
    power[0, -1, -1] = 1.0
    return Columns(grams, power, np.zeros((size, size)))


def gain(amplitudes: tuple[float, ...], seed: int = 1):
    base, effect, missing = records(np.random.default_rng(seed), amplitudes)
    blocks = Blocks.of([ROWS] * len(amplitudes), COUNT)
    both = [np.concatenate(pair) for pair in zip(base, effect, strict=True)]
    size = block_sums(blocks, [a * e[0] for a, e in zip(amplitudes, effect, strict=True)])
    before, after = judged(base, missing, blocks), judged(both, missing, blocks)
    return gain_of(before, after, size, 1, 1, blocks.record)


def test_left_out_errors_are_those_of_fits_without_the_block():
    base, effect, missing = records(np.random.default_rng(3), (0.3,))
    blocks = Blocks.of([ROWS], 6)
    both = [np.concatenate(pair) for pair in zip(base, effect, strict=True)]
    found = judged(both, missing, blocks).left_out_errors()
    A, b = both[0][:, :, 0].T, missing[0][:, 0]
    for number in range(6):
        inside = np.arange(ROWS) // (ROWS // 6) == number
        coefficients = np.linalg.lstsq(A[~inside], b[~inside], rcond=None)[0]
        expected = np.sum((b[inside] - A[inside] @ coefficients) ** 2)
        assert found[number] == pytest.approx(expected, rel=1e-8)


def test_effect_gains_its_own_square():
    found = gain((0.5, 0.5))
    # 2400 rows a record of 0.5 times a unit signal; noise of 2 sqrt(s) in each block.
    assert found.mean * COUNT == pytest.approx(2 * ROWS * 0.25, rel=0.1)
    assert found.statistic > 10.0
    assert found.elsewhere
    assert np.all(np.isfinite(found.others))


def test_nothing_gains_nothing():
    statistics = [gain((0.0, 0.0), seed).statistic for seed in range(40)]
    # Four standard errors are one in 30,000.
    assert max(statistics) < 4.0


def test_other_record_contradicts_the_other_sign():
    found = gain((0.5, -0.5))
    assert not found.elsewhere


def test_effect_that_lowers_the_force_that_sets_the_scale_gains_less():
    """Half of all forces gone with half of the error: nothing is explained."""
    rng = np.random.default_rng(4)
    force = rng.normal(size=(1, ROWS, 1))
    blocks = Blocks.of([ROWS], COUNT)
    grams = blocks.grams([0.5 * force], [force[0]])
    without = grams[:, 0, -1, -1]
    prior = np.diag([3.0 * float(grams[:, 0, 0, 0].sum()), 0.0])  # lets the effect take a quarter
    kept = np.array([[[0.0, 0.0], [0.0, 1.0]]])
    lowered = np.array([[[0.25, -0.5], [-0.5, 1.0]]])
    plain = Columns(grams, kept, prior).left_out_errors()
    assert np.all(plain < 0.7 * without)
    np.testing.assert_allclose(Columns(grams, lowered, prior).left_out_errors(), without, rtol=1e-6)


def test_one_block_alone_tells_nothing():
    gains, size = np.zeros(COUNT), np.full(COUNT, 1e-3)
    gains[5], size[5] = 100.0, 100.0
    assert gains.mean() < 4.0 * error_of_mean(gains, size)


def test_blocks_of_different_size_that_agree_scatter_little():
    size = np.array([1000.0, *np.full(COUNT - 1, 4.0)])
    noise = np.random.default_rng(5).normal(size=COUNT)
    gains = size + 2.0 * np.sqrt(size) * noise
    assert gains.mean() > 4.0 * error_of_mean(gains, size)


def test_gain_is_bounded_by_what_the_effect_does():
    np.testing.assert_allclose(bounded(np.array([1e6, -1e6, 3.0]), np.full(3, 4.0)), [12, -12, 3])
