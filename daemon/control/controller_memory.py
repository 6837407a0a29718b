"""Lay out the memory of a controller, which outlives the process of the loop."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

ROWS = 11
"""Rows (ROWS, 4) of state and scratch. Each array argument of a compiled function costs about 50 ns
a call, and the cycle must not allocate: they share one block. After these rows follow, flat: coil
heat (C,) in N^2, cycle of the heat, previous gaps (S,), cycle of the previous gaps, state of the
following check; at the end, state of the sensor checks."""


def following_size(coils: int) -> int:
    """Return the numbers of the following check, as its compiled code has them."""
    return 8 * (coils + 3)


def sensor_checks_size(sensors: int) -> int:
    """Return the numbers of the sensor checks, as their compiled code has them.

    Stated here too: the supervisor lays out the memory, and does not wait for the import of numba.
    """
    return 14 + sensors * (17 + sensors)


def memory_shape(coils: int, sensors: int) -> tuple[int, int]:
    """Return the shape of the memory array of a controller."""
    numbers = coils + sensors + 2 + following_size(coils)
    numbers += sensor_checks_size(sensors)
    return ROWS + (numbers + 3) // 4, 4


def checks_of(memory: Array, sensors: int) -> Array:
    """Return a view of the state of the sensor checks."""
    more = memory[ROWS:].reshape(-1)
    return more[more.size - sensor_checks_size(sensors) :]


def heat_of(memory: Array, coils: int) -> Array:
    """Return a view (C,) of the coil heat in a controller's memory: low-pass squared force, N^2."""
    return memory[ROWS:].ravel()[:coils]


def heated_of(memory: Array, coils: int) -> Array:
    """Return a view (1,) of the cycle at which the coil heat was computed."""
    return memory[ROWS:].ravel()[coils : coils + 1]
