"""Draw the deviation of two models' responses in dB and degrees with its 95 % band."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from ...identification.comparison.response_differences import ResponseComparison
from ...identification.subspace.response_uncertainty import SURE_95
from ..plotting.labelled_frequency_responses import SignalLabels
from ..plotting.panel_grid import entry, new_grid
from ..plotting.style import PAGE, Sheet, colour, drawing, frequency_axis, line_of

_TO_DB = 20.0 / np.log(10.0)


def deviation_figure(
    found: ResponseComparison, signals: SignalLabels, *, sheet: Sheet = PAGE
) -> Figure:
    """Draw B over A on the diagonal: dB in the upper row, degrees in the lower, a column a DOF.

    The band is 95 % of what the errors of both models explain, at each frequency alone.
    """
    columns = min(signals.shape)
    line = line_of(0)
    with drawing(sheet):
        legend = [
            entry("B over A", line),
            Patch(color=colour("muted"), alpha=0.3, label="95 % of chance, at each frequency"),
        ]
        grid = new_grid((2, columns), sheet, 1.7, legend)
        for (row, j), ax in grid.panels():
            with np.errstate(divide="ignore", invalid="ignore"):
                ratio = found.b.H[:, j, j] / found.a.H[:, j, j]
                level, phase = _TO_DB * np.log(np.abs(ratio)), np.degrees(np.angle(ratio))
            parts = [(m.error_re, m.error_im)[row][:, j, j] for m in (found.a, found.b)]
            band = SURE_95 * (_TO_DB, np.degrees(1.0))[row] * np.hypot(*parts)
            values = (level, phase)[row]
            frequency_axis(ax, (float(found.freq_hz[0]), float(found.freq_hz[-1])))
            ax.fill_between(
                found.freq_hz, -band, band, color=colour("muted"), alpha=0.3, linewidth=0
            )
            ax.axhline(0, color=colour("edge"), linewidth=0.8, zorder=1)
            ax.plot(found.freq_hz, values, **line.keywords())
            ax.set_title(signals.path(j, j))
            ax.set_title(("dB", "degrees")[row], loc="right", fontweight="normal")
            ax.tick_params(labelbottom=row == 1, length=2.5)
            if row == 1:
                ax.set_xlabel("frequency [Hz]")
    return grid.figure
