"""Draw the force that a model lacks over time, before and after a trace."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from ...identification.trace.force_trace.trace_imported import ForceTrace
from ..plotting.labelled_frequency_responses import symbol
from ..plotting.min_max_envelope import envelope, plot_envelope
from ..plotting.number_format import unit_text
from ..plotting.panel_grid import entry, new_grid
from ..plotting.style import PAGE, TRUTH, LineStyle, Sheet, colour, drawing, engineering

_BINS = 900
_ACTING = LineStyle(TRUTH.colour, width=1.8, alpha=0.6, zorder=2)
_BEFORE = LineStyle(colour("vermillion"), width=1.0, zorder=3)
_AFTER = LineStyle(colour("blue"), width=1.0, zorder=4)


def missing_force(trace: ForceTrace, *, sheet: Sheet = PAGE) -> Figure:
    """Draw the acting force and the missing one, a row per DOF, in the longest reported record."""
    record = max(trace.reported, key=lambda r: r.rows)
    acting = record.acting_force(trace.found.point)
    before, after = (record.missing_force(p) for p in (trace.declared, trace.found.point))
    legend = [
        entry("acting force", _ACTING),
        entry("missing before", _BEFORE),
        entry("missing after", _AFTER),
    ]
    names = trace.places.dof
    with drawing(sheet):
        grid = new_grid((len(names), 1), sheet, 2.1, legend)
        for i, ax in enumerate(grid.axes[:, 0]):
            unit = trace.places.force_unit(i)
            signals = [(acting, _ACTING), (before, _BEFORE), (after, _AFTER)]
            # Where a DOF rests, the force is 0: of the constant only what moves has a part.
            centred = [record.varying(x)[:, i] for x, _ in signals]
            factor, prefix = engineering(max(float(np.abs(x).max()) for x in centred), unit)
            for x, (_, line) in zip(centred, signals, strict=True):
                plot_envelope(ax, envelope(record.time_s, factor * x, _BINS), line)
            ax.set_title(symbol(names[i]))
            ax.set_title(prefix + unit_text(unit), loc="right", fontweight="normal")
            ax.margins(x=0)
            ax.tick_params(labelbottom=i == len(names) - 1, length=2.5)
        grid.axes[-1, 0].set_xlabel(f"time in the last part of {record.name} [s]")
    return grid.figure
