"""Test that decimated rows lose no spike, against numpy on the rows themselves."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from levid.daemon.ipc.row_ring import NO_LOG, Ring
from levid.daemon.live.decimation import Decimator
from levid.log.signals import cycle_dtype

DTYPE = cycle_dtype(5, 7)


def random_rows(count: int) -> NDArray[np.void]:
    random = np.random.default_rng(1)
    rows = np.zeros(count, DTYPE)
    for name in DTYPE.names:
        field = rows[name]
        field[...] = random.integers(0, 200, field.shape)
        if field.dtype.kind == "f":
            field *= -0.37
    rows["cycle"] = np.arange(count)
    return rows


def put(ring: Ring, rows: NDArray[np.void]) -> None:
    for row in rows:
        at = ring.head % ring.capacity
        ring.rows[at], ring.tags[at] = row, NO_LOG
        ring.head += 1


@pytest.mark.parametrize("factor", [1, 5, 20])
def test_minimum_maximum_and_last_row_of_each_interval(factor: int) -> None:
    ring, rows = Ring(DTYPE, 4096), random_rows(203)
    decimator = Decimator(ring, factor)
    found = []
    for part in np.split(rows, [7, 8, 100]):
        put(ring, part)
        while (now := decimator.read()) is not None:
            found.append(now)
    count = len(rows) // factor
    blocks = rows[: count * factor].reshape(count, factor)
    assert np.array_equal(np.concatenate([f.last for f in found]), blocks[:, -1])
    assert np.array_equal(np.concatenate([f.raw for f in found]), blocks.ravel())
    for name in DTYPE.names:
        low = np.concatenate([f.minimum[name] for f in found])
        high = np.concatenate([f.maximum[name] for f in found])
        np.testing.assert_array_equal(low, blocks[name].min(axis=1))
        np.testing.assert_array_equal(high, blocks[name].max(axis=1))
    assert not any(f.lost for f in found)


def test_a_single_reading_that_is_no_number_shows() -> None:
    ring, rows = Ring(DTYPE, 4096), random_rows(20)
    rows["gap_m"][3, 2] = np.nan
    decimator = Decimator(ring, 20)
    put(ring, rows)
    found = decimator.read()
    assert found is not None
    assert np.isnan(found.minimum["gap_m"][0]).tolist() == [k == 2 for k in range(7)]
    assert np.isnan(found.maximum["gap_m"][0]).tolist() == [k == 2 for k in range(7)]


def test_rows_before_the_start_and_skipped_rows_are_not_read() -> None:
    ring, rows = Ring(DTYPE, 4096), random_rows(60)
    put(ring, rows[:20])
    decimator = Decimator(ring, 10)
    put(ring, rows[20:40])
    decimator.skip()
    put(ring, rows[40:])
    found = decimator.read()
    assert found is not None
    assert found.raw["cycle"].tolist() == list(range(40, 60))


def test_overwritten_rows_are_counted() -> None:
    ring, rows = Ring(DTYPE, 64), random_rows(200)
    decimator = Decimator(ring, 10)
    put(ring, rows)
    found = decimator.read()
    assert found is not None
    assert found.lost == 200 - 64 + 1
    assert found.raw["cycle"][0] == found.lost
