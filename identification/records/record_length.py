"""Which records of an operating point are so short that they cost more than they tell."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from .record import Record

SHORT_SHARE = 0.1
"""Share of all rows that the records which are left out may hold."""
LONGER = 1.25
"""Rows of the shortest record that is left over those of the longest that is left out, at least."""


def long_enough(
    records: Sequence[Record], wanted_rows: int
) -> tuple[tuple[Record, ...], tuple[Record, ...]]:
    """Return the records to use and those to leave out, each in the order they came in.

    Impulse responses and segments are as long as the shortest record allows, up to what records of
    `wanted_rows` do. Of shorter ones as many are left out as hold a tenth of all rows together at
    most, as long as the others excite all that they do, and are longer by a quarter.
    """
    by_length = sorted(range(len(records)), key=lambda i: len(records[i].y))
    rows = [len(records[i].y) for i in by_length]
    everything = np.any([r.excited for r in records], axis=0)
    out: set[int] = set()
    for count in range(1, len(records)):
        left = [records[i] for i in by_length[count:]]
        excited = np.any([r.excited for r in left], axis=0)
        if (
            rows[count - 1] >= wanted_rows
            or sum(rows[:count]) > SHORT_SHARE * sum(rows)
            or not np.array_equal(excited, everything)
        ):
            break
        if rows[count] >= LONGER * rows[count - 1]:
            out = set(by_length[:count])
    used = tuple(r for i, r in enumerate(records) if i not in out)
    return used, tuple(records[i] for i in sorted(out))


def left_out_remarks(left_out: Sequence[Record]) -> tuple[str, ...]:
    """Return for each record that was left out what it would have done."""
    return tuple(
        f"'{r.name}' is left out: its {len(r.y)} rows would shorten the impulse response of all"
        for r in left_out
    )
