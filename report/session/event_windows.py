"""Choose the rows of a log that an interactive chart shows sample by sample at any page size."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

_BEFORE_S, _AFTER_S = 0.05, 0.2
_LEAST_ROWS = 16
_MOST_EVENTS = 24

Window = tuple[int, int]


def event_windows(rows: NDArray[Any], rate_hz: float, most_rows: int) -> list[Window]:
    """Return half-open ranges of rows around events, sorted and disjoint.

    Events are the log's first row, the first rows of faults, of other states of the loop, and of
    runs of saturated coils, in this order of importance: with more than 24, the later ones have no
    window. All windows have at most `most_rows` rows, unless 16 rows an event are more.
    """
    n = len(rows)
    firsts = [np.zeros(1, int)]
    for name in ("fault", "state", "saturated"):
        if name in (rows.dtype.names or ()):
            values = rows[name]
            begins = np.flatnonzero(np.diff(values != 0 if name == "saturated" else values)) + 1
            if name == "saturated":
                begins = np.append([0] if n and values[0] else [], begins[values[begins] != 0])
            firsts.append(begins.astype(int))
    events = np.concatenate(firsts)[:_MOST_EVENTS]
    length = max(most_rows // len(events), _LEAST_ROWS)
    before = min(int(_BEFORE_S * rate_hz), length // 5)
    after = min(int(_AFTER_S * rate_hz), length - before)
    windows: list[Window] = []
    for start, end in sorted((max(e - before, 0), min(e + after, n)) for e in events.tolist()):
        if windows and start <= windows[-1][1]:
            windows[-1] = (windows[-1][0], max(end, windows[-1][1]))
        elif end > start:
            windows.append((start, end))
    return windows
