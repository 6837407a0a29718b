"""Test place, sign and scale of channels from motions that are known, and readings at rest."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from levid.daemon.commissioning.coil_order import coil_order
from levid.daemon.commissioning.errors import CommissionError
from levid.daemon.commissioning.resting_readings import clipped, resting
from levid.daemon.commissioning.sensor_order import (
    Followed,
    at_the_stops,
    on_the_way,
    sensor_order,
)
from levid.model.geometry import shape_matrix

A, STROKE = 0.12, 1.8e-3
X, Y = A * np.repeat([1.0, 0.0, -1.0], 3), A * np.tile([1.0, 0.0, -1.0], 3)
SHAPE = shape_matrix(tuple(X), tuple(Y))


def held(order, scale):
    """Return the changes of the sensors' readings in the three holds."""
    turned = 0.5 * STROKE / A
    poses = np.array([[0, 0, STROKE], [0, turned, STROKE / 2], [turned, 0, STROKE / 2]])
    return [scale * (SHAPE @ pose)[order] for pose in poses]


def test_each_sensor_tells_its_own_place_and_scale() -> None:
    rng = np.random.default_rng(4)
    for _ in range(20):
        order = rng.permutation(9)
        scale = rng.uniform(0.7, 1.3, 9) * rng.choice([-1, 1], 9)
        found = sensor_order(at_the_stops(*held(order, scale), (A, A), STROKE), X, Y)
        np.testing.assert_array_equal(found.place, order)
        np.testing.assert_allclose(found.scale, scale, rtol=1e-9)
        assert not found.doubtful.any()
        assert not found.dead.any()


def test_dead_sensor_has_no_place_and_one_between_two_is_in_doubt() -> None:
    order, scale = np.arange(9), np.ones(9)
    scale[3] = 0.0
    changes = held(order, scale)
    changes[1][0] -= 0.2 * STROKE  # 0.4 places off along x
    found = sensor_order(at_the_stops(*changes, (A, A), STROKE), X, Y)
    assert found.dead.tolist() == [i == 3 for i in range(9)]
    assert found.doubtful.tolist() == [i == 0 for i in range(9)]


def test_sensor_whose_range_ends_is_found_on_the_way() -> None:
    """Also if it is inside its range on two ways only, during neither of which theta changes."""
    way, stay = np.linspace(0.0, 1.0, 8), np.ones(20)
    whole, turned = np.array([0, 0, STROKE / 2]), 0.5 * STROKE / A
    rest, x_side, y_side = -whole, np.array([0, turned, 0]), np.array([turned, 0, 0])
    holds = (rest, whole, x_side, y_side, rest)
    pose = np.concatenate(
        [
            np.concatenate([np.outer(stay, one), one + np.outer(way, other - one)])
            for one, other in itertools.pairwise(holds)
        ]
    )
    for place in (0, 2, 6, 8):
        for scale in (-1.2, 1.2):
            reading = np.clip(scale * (pose @ SHAPE[place]) + 4e-5, -1e-3, 1e-3)
            found = on_the_way(reading, pose, X, Y, STROKE)
            assert found == pytest.approx((scale, X[place], Y[place]), rel=1e-6)
    assert on_the_way(0.0 * reading + 1e-6, pose, X, Y, STROKE)[0] == 0.0


@pytest.mark.parametrize("dead", [None, 0, 4])
def test_coils_are_told_apart_whatever_the_stops_yield(dead) -> None:
    """The compliance of the stops to height and tilts is not known."""
    rng = np.random.default_rng(5)
    for _ in range(20):
        order = rng.permutation(9)
        gain = rng.uniform(0.8, 1.2, 9) * rng.choice([-1, 1], 9)
        if dead is not None:
            gain[dead] = 0.0
        compliance = rng.uniform(0.5, 2.0, 3) * [1e-5, 1e-5, 1e-7]
        pose = gain[:, None] * compliance * SHAPE[order]
        sd = np.array([3e-8, 3e-8, 1e-9])
        found = coil_order(pose + sd * rng.standard_normal((9, 3)), sd, X, Y)
        alive = np.arange(9) != dead
        np.testing.assert_array_equal(found.place[alive], order[alive])
        np.testing.assert_array_equal(found.dead, ~alive)
        usual = np.median(np.abs(gain[alive]))
        # The height of a coil is known to 1 to 2 %, that of the median one as well.
        np.testing.assert_allclose(found.gain[alive], gain[alive] / usual, atol=0.1)


def test_nothing_is_said_of_coils_below_the_noise() -> None:
    rng = np.random.default_rng(6)
    sd = np.array([3e-8, 3e-8, 1e-8])
    with pytest.raises(CommissionError, match=r"9 of 9 coils.*--force-n"):
        coil_order(sd * rng.standard_normal((9, 3)), sd, X, Y)


@pytest.mark.parametrize("dead", [(0, 1, 2), (0, 2, 6, 8), (1, 4)])
def test_coils_beside_dead_ones_are_not_accused(dead) -> None:
    rng = np.random.default_rng(8)
    gain = rng.choice([-1.0, 1.0], 9)
    gain[list(dead)] = 0.0
    sd = np.array([3e-8, 3e-8, 1e-9])
    pose = gain[:, None] * np.array([1e-5, 1.4e-5, 1.2e-7]) * SHAPE
    found = coil_order(pose + sd * rng.standard_normal((9, 3)), sd, X, Y)
    assert found.place.tolist() == [-1 if i in dead else i for i in range(9)]
    assert not found.doubtful.any()


def test_mains_and_clipping_at_rest() -> None:
    rng, t = np.random.default_rng(7), np.arange(2000) / 1000.0
    step = 31e-9
    gap = -9e-4 + 1e-7 * rng.standard_normal((2000, 4))
    gap[:, 1] += 3e-7 * np.sin(2 * np.pi * 50.0 * t)
    gap[:, 2] = np.maximum(gap[:, 2], -9e-4)  # half of it is cut off
    gap[:, 3] = -1e-3
    gap = step * np.round(gap / step)
    found = resting(gap, 1000.0)
    assert found.clipped.tolist() == [False, False, True, True]
    assert found.mains_hz == 50.0
    assert found.mains_m[1] == pytest.approx(3e-7, rel=0.05)
    assert found.mains_m[0] == 0.0
    assert found.sd_m[0] == pytest.approx(1e-7, rel=0.1)
    assert clipped(gap).tolist() == found.clipped.tolist()
    # A bus that stood still repeats a row, which may be an extreme one.
    stale = np.concatenate([gap[:, :2], np.repeat(gap[None, gap[:, 0].argmax(), :2], 700, axis=0)])
    assert not clipped(stale).any()


def test_a_place_is_given_once() -> None:
    """Two sensors that seem to be at one place: the better one gets it."""
    x, y = X.copy(), Y.copy()
    x[1], y[1] = X[0] - 0.01, Y[0]
    found = sensor_order(Followed(np.ones(9), x, y), X, Y)
    assert sorted(found.place.tolist()) == list(range(9))
    assert found.place[0] == 0
    assert found.doubtful[1]
