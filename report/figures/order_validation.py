"""Draw the cross-validation error of models over their order."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from ..plotting.panel_grid import new_grid
from ..plotting.style import PAGE, LineStyle, Sheet, colour, drawing

Array = NDArray[np.float64]


@dataclass(frozen=True)
class OrderErrors:
    """Errors of the models of order 1, 2, ... (orders,), NaN if missing, and the chosen order."""

    title: str
    line: LineStyle
    error: Array
    chosen: int


def validation_errors(kinds: Sequence[OrderErrors], *, sheet: Sheet = PAGE) -> Figure:
    """Draw one panel per kind of model: error relative to the outputs' RMS over the order."""
    with drawing(sheet):
        grid = new_grid((1, max(len(kinds), 1)), sheet, 2.6)
        for ax, kind in zip(grid.axes[0], kinds, strict=False):
            orders = np.arange(1, len(kind.error) + 1)
            # Errors far above 1, of models of too high order, need not be visible.
            ax.plot(orders, kind.error, color=kind.line.colour, marker="o", markersize=4.5)
            ax.axvline(kind.chosen, color=colour("ink"), linewidth=0.8, linestyle=(0, (2, 2)))
            known = kind.error[np.isfinite(kind.error)]
            top = min(1.1 * known.max(initial=0.1), max(1.1, 3 * known.min(initial=1.0)))
            ax.set_ylim(0, top)
            ax.xaxis.set_major_locator(MaxNLocator(integer=True, nbins=10))
            ax.set_title(f"{kind.title}: order {kind.chosen}")
            ax.set_title("error / rms", loc="right", fontweight="normal")
            ax.set_xlabel("order")
    return grid.figure
