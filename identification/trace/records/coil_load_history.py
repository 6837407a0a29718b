"""Compute the coil loads of a session, which determine the coils' heat when a record begins."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ....model.effects.base import Loads
from .record_from_log import TraceRecord

_BLOCK_S = 2.0


def loads_of(records: Sequence[TraceRecord]) -> Loads:
    """Return mean squares of the coil commands over a session, in blocks of 2 s.

    Between records, the first half of the time has the load before, the second half the load after.
    """
    times: list[float] = []
    squares: list[tuple[float, ...]] = []
    end_s = -np.inf
    for record in sorted(records, key=lambda r: float(r.time_s[0])):
        rows = max(round(_BLOCK_S / record.experiment.Ts_s), 1)
        for first in range(0, record.rows, rows):
            begin_s = float(record.time_s[first])
            between = first == 0 and np.isfinite(end_s)
            times.append(0.5 * (begin_s + end_s) if between else begin_s)
            command = record.coil[first : first + rows]
            squares.append(tuple(np.mean(command * command, axis=0).tolist()))
        end_s = float(record.time_s[-1])
    return Loads(tuple(times), tuple(squares))
