"""Compute the actuators' loads over a session, which determine their heat when a record begins."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ....model.effects.base import Loads
from .check_common_session_time import overlap
from .record_from_log import TraceRecord

_BLOCK_S = 2.0


def in_one_session(records: Sequence[TraceRecord]) -> list[TraceRecord]:
    """Return records that know the span of their session, and the loads over it.

    The loads are unknown if the records overlap in time.
    """
    span = min(r.time_s[0] for r in records), max(r.time_s[-1] for r in records)
    loads = None if overlap(records) else loads_of(records)
    return [replace(r, places=replace(r.places, span_s=span, loads=loads)) for r in records]


def loads_of(records: Sequence[TraceRecord]) -> Loads:
    """Return mean squares of the coil commands over a session, in blocks of 2 s.

    Between records, the first half of the time has the load before, the second half the load after.
    """
    found: list[tuple[float, tuple[float, ...], bool]] = []
    end_s = -np.inf
    for record in sorted(records, key=lambda r: float(r.time_s[0])):
        rows = max(round(_BLOCK_S / record.experiment.Ts_s), 1)
        for first in range(0, record.rows, rows):
            begin_s = float(record.time_s[first])
            command = record.coil[first : first + rows]
            load = tuple(np.mean(command * command, axis=0).tolist())
            if first == 0 and found:
                found += [(end_s, found[-1][1], True), (0.5 * (begin_s + end_s), load, True)]
            found.append((begin_s, load, False))
        end_s = float(record.time_s[-1])
    times_s, squares, between = zip(*found, strict=True)
    return Loads(times_s, squares, between)
