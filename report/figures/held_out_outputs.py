"""Draw held-out outputs: measured, predicted one step ahead, simulated."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from ..plotting.labelled_frequency_responses import symbol
from ..plotting.min_max_envelope import envelope, plot_envelope
from ..plotting.panel_grid import entry, new_grid
from ..plotting.style import PAGE, TRUTH, LineStyle, Sheet, colour, drawing

Array = NDArray[np.float64]

_BINS = 1000
_MEASURED = LineStyle(TRUTH.colour, width=2.4, alpha=0.6, zorder=2)
_ONE_STEP = LineStyle(colour("blue"), width=1.0)
_SIMULATED = LineStyle(colour("vermillion"), (5.0, 1.6), width=1.2, zorder=4)


@dataclass(frozen=True)
class HeldOut:
    """Held-out outputs (N, m) at t_s (N,), measured, predicted and simulated.

    Fits (m,) are in percent, 100 (1 − |y − ŷ| / |y − mean y|).
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    t_s: Array
    measured: Array
    simulated: Array
    simulated_fit: Array
    one_step: Array | None = None
    one_step_fit: Array | None = None


def held_out_outputs(tail: HeldOut, *, sheet: Sheet = PAGE) -> Figure:
    """Draw one row per output with its fits in percent next to its name."""
    legend = [entry("measured", _MEASURED)]
    if tail.one_step is not None:
        legend.append(entry("one step ahead", _ONE_STEP))
    if np.isfinite(tail.simulated).any():  # an unstable model does not simulate
        legend.append(entry("simulated", _SIMULATED))
    with drawing(sheet):
        grid = new_grid((len(tail.names), 1), sheet, 1.9, legend)
        for i, ax in enumerate(grid.axes[:, 0]):
            signals = [(tail.measured, _MEASURED), (tail.one_step, _ONE_STEP)]
            for values, line in [*signals, (tail.simulated, _SIMULATED)]:
                if values is not None:
                    plot_envelope(ax, envelope(tail.t_s, values[:, i], _BINS), line)
            unit = f" [{tail.units[i]}]" if tail.units[i] not in ("", "1") else ""
            ax.set_title(symbol(tail.names[i]) + unit)
            ax.set_title(_fits(tail, i), loc="right", fontweight="normal")
            ax.margins(x=0)
            ax.tick_params(labelbottom=i == len(tail.names) - 1, length=2.5)
            span = tail.measured[:, i][np.isfinite(tail.measured[:, i])]
            if span.size and np.ptp(span) > 0:
                margin = 0.15 * np.ptp(span)  # an unstable simulation must not flatten the data
                ax.set_ylim(span.min() - margin, span.max() + margin)
        grid.axes[-1, 0].set_xlabel("time [s]")
    return grid.figure


def _fits(tail: HeldOut, i: int) -> str:
    fits = [("simulated", tail.simulated_fit[i])]
    if tail.one_step_fit is not None:
        fits.insert(0, ("one step ahead", tail.one_step_fit[i]))
    texts = [f"{kind} {fit:.1f} %" for kind, fit in fits if np.isfinite(fit)]
    return f"fit: {', '.join(texts)}" if texts else ""
