"""Where readings stand still though the platform moves: found to the row, and nowhere else."""

from __future__ import annotations

import numpy as np
import pytest
from rig_effects import rig_places
from scipy.signal import lfilter

from levid.identification.trace.records.stuck_sensors import stuck_rows

TS = 1e-3
ROWS = 20_000
SD_M = 1e-7
SHAPE = rig_places().sensor_shape
TIMES = range(500, ROWS - 500, 1000)


def true_gaps(seed: int) -> np.ndarray:
    """Heights (N, S) of a platform that tilts and lifts by some 20 um up to 15 Hz."""
    rng = np.random.default_rng(seed)
    t = np.arange(ROWS) * TS
    size_m = 2e-5 / np.abs(SHAPE).max(axis=0)
    q = sum(
        np.sin(2 * np.pi * f * t[:, None] + rng.uniform(0, 2 * np.pi, 3)) * size_m / 3
        for f in (1.3, 3.9, 8.7, 15.1)
    )
    return q @ SHAPE.T


def noise(seed: int) -> np.ndarray:
    return np.random.default_rng([seed, 1]).normal(0.0, SD_M, (ROWS, 9))


def held_for(gaps: np.ndarray, sensor: int, rows: int) -> np.ndarray:
    """Let a sensor stand for so many rows at TIMES, in place; returns where (N,)."""
    stuck = np.zeros(ROWS, bool)
    for first in TIMES:
        gaps[first : first + rows, sensor] = gaps[first - 1, sensor]
        stuck[first : first + rows] = True
    return stuck


@pytest.mark.parametrize("rows", [15, 40, 200])
@pytest.mark.parametrize("repeats", [False, True])
def test_stands_are_found_to_a_row_or_two(rows: int, repeats: bool) -> None:
    """With noise that goes on, or, where the converter itself repeats, with the noise kept too."""
    gaps = true_gaps(1)
    if repeats:
        readings = gaps + noise(1)
        stuck = held_for(readings, 4, rows)
    else:
        stuck = held_for(gaps, 4, rows)
        readings = gaps + noise(1)
    found = stuck_rows(readings, SHAPE)
    assert found is not None
    assert not np.any(np.delete(found, 4, axis=1))
    # Where the platform moves by 0.1 um in a row, its noise, nobody can tell one row from the next.
    assert np.sum(found[:, 4] & ~stuck) < 5 * len(TIMES)
    # What it moves by less than 2 um meanwhile is told by nothing.
    moved = [np.ptp(true_gaps(1)[first - 1 : first + rows, 4]) > 3e-6 for first in TIMES]
    assert sum(moved) >= len(TIMES) // 2
    told = [
        found[first : first + rows, 4].mean()
        for first, far in zip(TIMES, moved, strict=True)
        if far
    ]
    assert min(told) > 0.8


def test_two_sensors_that_stand_at_times_of_their_own_are_told_apart() -> None:
    gaps = true_gaps(2)
    first = held_for(gaps, 0, 30)
    gaps[:, 8] = np.roll(gaps[:, 8], -250)
    second = np.roll(held_for(gaps, 8, 30), 250)
    gaps[:, 8] = np.roll(gaps[:, 8], 250)
    found = stuck_rows(gaps + noise(2), SHAPE)
    assert found is not None
    assert set(np.flatnonzero(found.any(axis=0))) == {0, 8}
    for stuck, sensor in ((first, 0), (second, 8)):
        assert np.mean(found[stuck, sensor]) > 0.7
        assert np.mean(stuck[found[:, sensor]]) > 0.9


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("wrong", ["nothing", "gain", "lag", "noisy", "coarse", "at rest"])
def test_what_follows_the_platform_never_stands(wrong: str, seed: int) -> None:
    gaps = true_gaps(seed)
    own = noise(seed)
    if wrong == "gain":
        gaps[:, 3] *= 0.7
    elif wrong == "lag":
        decay = np.exp(-TS / 3e-3)
        gaps[:, 3] = lfilter([1 - decay], [1, -decay], gaps[:, 3])
    elif wrong == "noisy":
        own[:, 3] *= 30.0
    elif wrong == "at rest":
        gaps *= 0.0
    readings = gaps + own
    if wrong == "coarse":
        readings = np.round(readings / 31e-9) * 31e-9
    assert stuck_rows(readings, SHAPE) is None


def test_without_sensors_to_spare_nobody_can_say() -> None:
    readings = (true_gaps(1) + noise(1))[:, :4]
    held_for(readings, 1, 40)
    assert stuck_rows(readings, SHAPE[:4]) is None
