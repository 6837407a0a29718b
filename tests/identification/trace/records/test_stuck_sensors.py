"""Test the detection of stuck sensors: rows are found exactly, without false alarms."""

from __future__ import annotations

import numpy as np
import pytest
from effect_test_helpers import rig_places
from scipy.signal import lfilter

from levid.identification.trace.records.stuck_sensors import stuck_rows

TS = 1e-3
ROWS = 20_000
SD_M = 1e-7
SHAPE = rig_places().sensor_shape
TIMES = range(500, ROWS - 500, 1000)


def true_gaps(seed: int) -> np.ndarray:
    """Return gaps (N, S) of a platform that tilts and lifts by about 20 um at up to 15 Hz."""
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


def hold_sensor(gaps: np.ndarray, sensor: int, rows: int) -> np.ndarray:
    """Hold a sensor's value for `rows` rows at each of TIMES, in place; return the mask (N,)."""
    stuck = np.zeros(ROWS, bool)
    for first in TIMES:
        gaps[first : first + rows, sensor] = gaps[first - 1, sensor]
        stuck[first : first + rows] = True
    return stuck


@pytest.mark.parametrize("rows", [15, 40, 200])
@pytest.mark.parametrize("repeats", [False, True])
def test_rows_of_a_stuck_sensor_are_found(rows: int, repeats: bool) -> None:
    """The noise continues, or is held as well if the converter repeats its value (`repeats`)."""
    gaps = true_gaps(1)
    if repeats:
        readings = gaps + noise(1)
        stuck = hold_sensor(readings, 4, rows)
    else:
        stuck = hold_sensor(gaps, 4, rows)
        readings = gaps + noise(1)
    found = stuck_rows(readings, SHAPE)
    assert found is not None
    assert not np.any(np.delete(found, 4, axis=1))
    # A motion of 0.1 um per row equals the noise, so single rows are uncertain.
    assert np.sum(found[:, 4] & ~stuck) < 5 * len(TIMES)
    # A sensor that should have moved by less than 2 um is not detectable.
    moved = [np.ptp(true_gaps(1)[first - 1 : first + rows, 4]) > 3e-6 for first in TIMES]
    assert sum(moved) >= len(TIMES) // 2
    detected_share = [
        found[first : first + rows, 4].mean()
        for first, far in zip(TIMES, moved, strict=True)
        if far
    ]
    assert min(detected_share) > 0.8


def test_two_stuck_sensors_are_found_separately() -> None:
    gaps = true_gaps(2)
    first = hold_sensor(gaps, 0, 30)
    gaps[:, 8] = np.roll(gaps[:, 8], -250)
    second = np.roll(hold_sensor(gaps, 8, 30), 250)
    gaps[:, 8] = np.roll(gaps[:, 8], 250)
    found = stuck_rows(gaps + noise(2), SHAPE)
    assert found is not None
    assert set(np.flatnonzero(found.any(axis=0))) == {0, 8}
    for stuck, sensor in ((first, 0), (second, 8)):
        assert np.mean(found[stuck, sensor]) > 0.7
        assert np.mean(stuck[found[:, sensor]]) > 0.9


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("wrong", ["nothing", "gain", "lag", "noisy", "coarse", "at rest"])
def test_sensor_with_another_fault_is_not_reported_as_stuck(wrong: str, seed: int) -> None:
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


def test_no_result_without_redundant_sensors() -> None:
    readings = (true_gaps(1) + noise(1))[:, :4]
    hold_sensor(readings, 1, 40)
    assert stuck_rows(readings, SHAPE[:4]) is None
