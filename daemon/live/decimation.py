"""Decimate log rows for a live view: the last row, minimum and maximum of each interval."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..ipc.row_ring import Ring

_MOST_ROWS = 8192
"""Rows that are copied at a time."""


@dataclass(frozen=True)
class Decimated:
    """Hold intervals (g,) of rows: their last row, and minimum and maximum of each field.

    `raw`: all rows (g times the rows of an interval,). `lost`: rows before these that the loop
    overwrote before they were read.
    """

    raw: NDArray[np.void]
    last: NDArray[np.void]
    minimum: NDArray[np.void]
    maximum: NDArray[np.void]
    lost: int


class Decimator:
    """Read a ring of rows without writing to it, in intervals of `factor` rows.

    The intervals follow each other without gaps, so every row is in one: no spike is lost. A value
    that is not a number makes minimum and maximum of its interval not a number.
    """

    def __init__(self, ring: Ring, factor: int) -> None:
        self._ring, self.factor = ring, factor
        self._next = ring.head
        self._runs = _runs_of(ring.dtype)

    def skip(self) -> None:
        """Skip the rows written so far, while no client watches."""
        self._next = self._ring.head

    def read(self) -> Decimated | None:
        """Return the complete intervals since the last call, or None without one."""
        factor = self.factor
        most = max(_MOST_ROWS // factor, 1) * factor
        found = self._ring.copy(self._next, most)
        intervals = len(found.rows) // factor
        if not intervals:
            return None
        raw = found.rows[: intervals * factor]
        lost, self._next = found.first - self._next, found.first + len(raw)
        minimum, maximum = np.empty(intervals, raw.dtype), np.empty(intervals, raw.dtype)
        for begin, kind, count in self._runs:
            values = _values(raw, begin, kind, count).reshape(intervals, factor, count)
            np.min(values, axis=1, out=_values(minimum, begin, kind, count))
            np.max(values, axis=1, out=_values(maximum, begin, kind, count))
        return Decimated(raw, raw[factor - 1 :: factor], minimum, maximum, lost)


_Run = tuple[int, np.dtype[np.generic], int]
"""Offset, type and number of consecutive values of one type."""


def _runs_of(dtype: np.dtype[np.void]) -> list[_Run]:
    """Return the runs of equal types: few calls instead of one for each field."""
    runs: list[_Run] = []
    for name in dtype.names or ():
        field, begin = dtype[name], int(dtype.fields[name][1])  # type: ignore[index]
        count = int(np.prod(field.shape, dtype=int))
        if runs and runs[-1][1] == field.base:
            first, kind, before = runs[-1]
            if first + before * kind.itemsize == begin:
                runs[-1] = first, kind, before + count
                continue
        runs.append((begin, field.base, count))
    return runs


def _values(
    rows: NDArray[np.void], begin: int, kind: np.dtype[np.generic], count: int
) -> NDArray[np.generic]:
    """Return the values of a run as a view (rows, count)."""
    size = rows.dtype.itemsize
    return np.ndarray(
        (len(rows), count), kind, rows.view(np.uint8).data, begin, (size, kind.itemsize)
    )
