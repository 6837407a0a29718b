"""Leave out short records, which would shorten the impulse response estimated from all records."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from .record import Record

MAX_LEFT_OUT_SHARE = 0.1
"""Largest share of all rows that may be left out."""
LENGTH_RATIO = 1.25
"""Smallest ratio of the shortest used record to the longest one left out, in rows."""


def drop_short_records(
    records: Sequence[Record], wanted_rows: int
) -> tuple[tuple[Record, ...], tuple[Record, ...]]:
    """Return the records to use and the records to leave out, both in their original order.

    The shortest record limits the length of impulse responses and segments; a record of
    `wanted_rows` does not. The shortest records are left out if together they hold at most a tenth
    of all rows, if the others excite the same inputs, and if those are longer by a quarter.
    """
    by_length = sorted(range(len(records)), key=lambda i: len(records[i].y))
    rows = [len(records[i].y) for i in by_length]
    everything = np.any([r.excited for r in records], axis=0)
    left_out: set[int] = set()
    for count in range(1, len(records)):
        remaining = [records[i] for i in by_length[count:]]
        excited = np.any([r.excited for r in remaining], axis=0)
        if (
            rows[count - 1] >= wanted_rows
            or sum(rows[:count]) > MAX_LEFT_OUT_SHARE * sum(rows)
            or not np.array_equal(excited, everything)
        ):
            break
        if rows[count] >= LENGTH_RATIO * rows[count - 1]:
            left_out = set(by_length[:count])
    used = tuple(r for i, r in enumerate(records) if i not in left_out)
    return used, tuple(records[i] for i in sorted(left_out))


def left_out_remarks(left_out: Sequence[Record]) -> tuple[str, ...]:
    """Return a remark for each record left out."""
    return tuple(
        f"'{r.name}' is left out: its {len(r.y)} rows would shorten the impulse response of all"
        for r in left_out
    )
