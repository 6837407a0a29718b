"""Test the detection of clipped signals on signals that are clipped and that are not."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.special import ndtr

from levid.log.importing.clipping import clipped_levels, clipping_remarks

N = 5000
ROW = np.arange(N)
RNG = np.random.default_rng(1)
NOISE = RNG.standard_normal(N)


@pytest.mark.parametrize(
    "values",
    [
        NOISE,
        RNG.uniform(size=N),
        np.sin(0.0137 * ROW),
        np.round(128 * np.sin(0.0137 * ROW)),  # of an 8-bit converter
        np.sin(2 * np.pi * ROW / 100),
        np.abs(ROW % 200 - 100.0),
        np.sign(NOISE),
        np.sign(NOISE) + 0.01 * RNG.standard_normal(N),
        np.repeat(RNG.integers(-3, 4, 50), 100).astype(float),
        np.concatenate(
            [np.full(2000, NOISE.min() - 1.0), NOISE, np.zeros(500)]
        ),  # rest at the ends
        np.zeros(N),
        np.full(N, np.nan),
    ],
    ids=lambda _: "",
)
def test_signal_that_is_not_clipped(values):
    assert clipped_levels(values) == []


@pytest.mark.parametrize("limit", [1.0, 1.5, 2.0])
def test_clipped_noise_gives_level_and_share(limit):
    high, low = clipped_levels(np.clip(NOISE, -limit, limit))
    assert (high.level, high.side) == (limit, "highest")
    assert (low.level, low.side) == (-limit, "lowest")
    # Beyond the limit, and in the outermost bin; three standard deviations of a share.
    share = 1.0 - ndtr(limit)
    assert high.share == pytest.approx(share + 0.002, abs=3 * np.sqrt(share / N) + 0.002)


def test_clipped_measurement_with_noise_and_missing_values():
    values = np.clip(NOISE, -9.0, 1.0) + 1e-3 * RNG.standard_normal(N)
    values[::100] = np.nan
    (level,) = clipped_levels(values)
    assert level.side == "highest"
    assert level.level == pytest.approx(1.0, abs=0.01)


def test_remark_says_level_share_and_consequence():
    (remark, _) = clipping_remarks("u_v", "V", np.clip(NOISE, -1.5, 1.5), output=False)
    assert remark.startswith("u_v rests at its highest value, 1.5 V, in ")
    assert "if only the measurement is clipped" in remark
    (remark, _) = clipping_remarks("y", "1", np.clip(NOISE, -1.5, 1.5), output=True)
    assert remark.startswith("y rests at its highest value, 1.5, in ")
    assert "end of its range" in remark


def test_moves_that_end_at_rest_are_not_clipped_but_moves_that_are_cut_off_are() -> None:
    """Point-to-point moves rest at their highest position, which they reach slowly."""
    share = np.linspace(0.0, 1.0, 1500)
    move = share - np.sin(2 * np.pi * share) / (2 * np.pi)  # begins and ends without speed
    rest = np.ones(400)
    position = np.concatenate([move, rest, 1.0 - 0.6 * move, 0.4 * rest, 0.4 + 0.6 * move, rest])
    position = np.append(position, 1.0 - move)
    noisy = position + np.random.default_rng(3).normal(0.0, 1e-4, len(position))
    assert clipping_remarks("x", "m", noisy, output=True) == []
    assert clipping_remarks("f", "N", noisy, output=False)  # of an input, speed tells nothing
    assert clipping_remarks("x", "m", np.minimum(noisy, 0.7), output=True)


def test_steps_of_many_sizes_are_not_clipped_at_the_largest() -> None:
    rng = np.random.default_rng(1)
    levels = np.repeat(rng.uniform(-10.0, 10.0, 200), 50)
    assert clipped_levels(levels) == []
    # A random signal that is cut off is, also where a converter of 8 bits reads it.
    cut = np.clip(np.convolve(rng.standard_normal(10_000), np.ones(20) / 5.0, "same"), -1.2, 1.2)
    assert len(clipped_levels(np.round(cut * 50.0) / 50.0)) == 2


@pytest.mark.parametrize("begins", [True, False])
def test_a_move_from_or_to_a_rest_at_the_end_of_its_range_is_not_cut_off(begins: bool) -> None:
    rng, moving = np.random.default_rng(3), np.linspace(0.0, np.pi, 2000)
    # It rests for 300 rows where it has its lowest value, and is in full motion at the other end.
    path = np.concatenate([np.zeros(300), 1.0 - np.cos(moving), np.full(100, 1.9)])
    path += 2e-5 * rng.normal(size=len(path))
    values = path if begins else path[::-1]
    assert [found.side for found in clipped_levels(values, halted=True)] == []
