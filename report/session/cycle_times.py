"""Draw histograms of lateness and execution time of a real-time flight's cycles."""

from __future__ import annotations

import numpy as np
from matplotlib.artist import Artist
from matplotlib.figure import Figure
from numpy.typing import NDArray

from ..plotting.panel_grid import entry, new_grid
from ..plotting.style import BOUND, PAGE, LineStyle, Sheet, colour, drawing, log_ticks
from .flight_data import CycleTimes

_AXIS_START_US = 0.05
"""Begin of the logarithmic axis, within the first bin, which begins at 0."""


def timing_histogram(timing: CycleTimes, *, sheet: Sheet = PAGE) -> Figure:
    """Draw histograms of lateness and execution time, both axes logarithmic, the period marked."""
    rows = (
        ("lateness", timing.lateness, LineStyle(colour("blue"))),
        ("execution time", timing.execution, LineStyle(colour("green"))),
    )
    edges = np.maximum(1e6 * timing.edges_s, _AXIS_START_US)
    most = max(int(timing.lateness.max(initial=1)), int(timing.execution.max(initial=1)))
    used = np.flatnonzero(timing.lateness + timing.execution)
    longest = max(3e6 * timing.period_s, 2 * edges[used[-1] + 1] if used.size else 0.0)
    legend: list[Artist] = [entry(f"period, {1e6 * timing.period_s:g} µs", BOUND)]
    with drawing(sheet):
        grid = new_grid((1, 2), sheet, 2.2, legend)
        for ax, (title, counts, line) in zip(grid.axes[0], rows, strict=True):
            log_ticks(ax, "x", (_AXIS_START_US, longest))
            log_ticks(ax, "y", (0.7, 2.0 * most))
            ax.stairs(counts, edges, fill=True, color=line.colour, linewidth=0)
            ax.axvline(1e6 * timing.period_s, **BOUND.keywords())
            ax.set_title(title)
            ax.set_title("cycles", loc="right", fontweight="normal")
            ax.set_xlabel("µs")
    return grid.figure


def quantile_s(counts: NDArray[np.int64], edges_s: NDArray[np.float64], share: float) -> float:
    """Return the quantile of a histogram: the upper edge in s of the bin that contains it."""
    total = np.cumsum(counts)
    if not total.size or not total[-1]:
        return float("nan")
    return float(edges_s[int(np.searchsorted(total, share * total[-1])) + 1])
