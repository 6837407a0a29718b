"""What the coils carried through a session: what is warm when a record begins was warmed before."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ....model.effects.base import Loads
from .trace_record import TraceRecord

_BLOCK_S = 2.0


def loads_of(records: Sequence[TraceRecord]) -> Loads:
    """Return mean squares of the commands in blocks of 2 s, of records one after the other.

    In between, where the beam is moved and nobody looks, the first half is as before, the second as
    after.
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
            told = record.coil[first : first + rows]
            squares.append(tuple(np.mean(told * told, axis=0).tolist()))
        end_s = float(record.time_s[-1])
    return Loads(tuple(times), tuple(squares))
