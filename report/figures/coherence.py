"""Draw the coherence of the sensitivity: share of the feedback that the excitation explains."""

from __future__ import annotations

from collections.abc import Sequence

from matplotlib.figure import Figure

from ..plotting.labelled_frequency_responses import Curve, Range, SignalLabels, inside
from ..plotting.panel_grid import legend_of, name_panel, new_grid, plot_curve
from ..plotting.style import PAGE, Sheet, drawing


def coherence(
    curves: Sequence[Curve], signals: SignalLabels, *, shown: Range, sheet: Sheet = PAGE
) -> Figure:
    """Draw the coherence of every path from 0 to 1; the curves' responses are coherences."""
    curves = [inside(c, shown) for c in curves]
    with drawing(sheet):
        grid = new_grid(signals.shape, sheet, 1.25, legend_of(curves, shown=shown))
        for (i, j), ax in grid.panels():
            ax.set_ylim(0, 1.05)
            ax.set_yticks([0, 0.5, 1])
            name_panel(ax, signals.path(i, j))
            for curve in curves:
                plot_curve(ax, curve, curve.response[:, i, j].real, faint=i != j)
        grid.finish_frequency(shown)
    return grid.figure
