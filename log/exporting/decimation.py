"""Reduce the rate of a log with a linear-phase low-pass filter, block by block.

Every N-th row alone would show frequencies above the new Nyquist frequency as lower ones
(aliasing). Therefore signals are filtered before: up to 0.8 of the new Nyquist frequency amplitudes
are exact to 0.1 %, above the Nyquist frequency they are attenuated by 70 dB. The filter has no
delay.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import numpy as np
from numpy.typing import NDArray

from ..log_stream import Block

_HALF_LENGTH = 22
"""Rows on either side of a kept row that the filter uses, in new sampling periods."""
PASS = 0.8
"""End of the pass band, as a share of the new Nyquist frequency."""
_STOP_DB = 70.0
MOST = 1000
"""Largest N: the filter holds 2 * 22 * N rows in memory."""
_KEPT = ("time_s", "cycle")
"""Fields that are times or counters: the value of the kept row."""
_SUMMARIES = {
    "fault": np.maximum,
    "saturated": np.maximum,
    "skipped": np.add,
    "stale": np.bitwise_or,
}
"""Whole numbers of which no row may be lost: those of N rows become one."""

Array = NDArray[np.float64]


def low_pass(every: int) -> Array:
    """Return the filter's coefficients, (2 * 22 * every + 1,), with the sum 1."""
    from scipy.signal import firwin

    edge = (1.0 + PASS) / 2.0 / every
    beta = 0.1102 * (_STOP_DB - 8.7)
    taps = firwin(2 * _HALF_LENGTH * every + 1, edge, window=("kaiser", beta))
    return np.asarray(taps / taps.sum(), np.float64)


def decimated(blocks: Iterable[Block], every: int) -> Iterator[Block]:
    """Yield blocks with every N-th row, the first included, with filtered signals.

    Floating-point fields are filtered; the first and last row are repeated beyond the ends.
    `fault` and `saturated` are the largest, `skipped` the sum, and `stale` all bits of N rows;
    other whole numbers, `cycle` and `time_s` are those of the kept row. NaN spreads over the
    filter.
    """
    if every == 1:
        yield from blocks
        return
    taps = low_pass(every)
    half = len(taps) // 2
    rows: NDArray[np.void] | None = None
    times = np.zeros(0, np.uint64)
    for block in blocks:
        if rows is None:
            rows, times = block.rows[:1].repeat(half), block.log_time_ns[:1].repeat(half)
        rows = np.concatenate([rows, block.rows])
        times = np.concatenate([times, block.log_time_ns])
        # Centres of the filter are half, half + every, ... of `rows`; N rows are summarised.
        count = (len(rows) - 2 * half - 1) // every + 1
        if count > 0:
            yield _reduced(rows, times, taps, every, count)
            rows, times = rows[count * every :], times[count * every :]
    if rows is None or len(rows) <= half:
        return
    count = -(-(len(rows) - half) // every)
    rows = np.concatenate([rows, _ended(rows[-1:], half + every)])
    times = np.concatenate([times, times[-1:].repeat(half + every)])
    yield _reduced(rows, times, taps, every, count)


def _ended(last: NDArray[np.void], count: int) -> NDArray[np.void]:
    """Return the last row repeated; what N rows add up to is not repeated."""
    rows = last.repeat(count)
    if "skipped" in (rows.dtype.names or ()):
        rows["skipped"] = 0
    return rows


def _reduced(
    rows: NDArray[np.void], times: NDArray[np.uint64], taps: Array, every: int, count: int
) -> Block:
    half = len(taps) // 2
    kept = slice(half, half + count * every, every)
    out = rows[kept].copy()
    for name in rows.dtype.names or ():
        kind = rows.dtype[name].base.kind
        if name in _SUMMARIES and kind in "ui":
            spans = rows[name][half : half + count * every].reshape(count, every)
            total = _SUMMARIES[name].reduce(spans, axis=1, dtype=np.int64)
            out[name] = np.minimum(total, np.iinfo(rows.dtype[name].base).max)
        elif kind == "f" and name not in _KEPT:
            out[name] = _filtered(rows[name], taps, every, count)
    return Block(out, times[kept])


def _filtered(x: NDArray[np.floating], taps: Array, every: int, count: int) -> Array:
    windows = np.lib.stride_tricks.sliding_window_view(
        np.ascontiguousarray(x, np.float64), len(taps), axis=0
    )
    return np.asarray(windows[: count * every : every] @ taps)
