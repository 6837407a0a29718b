"""Draw simulated and measured outputs: the paper's Fig. 14."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from numpy.typing import NDArray

from ...identification.subspace.response_uncertainty import SURE_95
from ..plotting.labelled_frequency_responses import symbol
from ..plotting.min_max_bins import attach, min_max_bins
from ..plotting.min_max_envelope import envelope, plot_envelope
from ..plotting.panel_grid import entry, new_grid
from ..plotting.style import PAGE, TRUTH, LineStyle, Sheet, colour, drawing, engineering

Array = NDArray[np.float64]

NOISE_BAND = SURE_95
"""95 % of Gaussian noise is within this many RMS."""
_BINS, _POINTS = 500, 1500
_SCHEDULE_IN, _OUTPUT_IN, _ERROR_IN = 1.1, 1.5, 1.1
_SCHEDULE = LineStyle(colour("ink"), width=1.1)
_MEASURED = LineStyle(TRUTH.colour, width=2.8, alpha=0.6, zorder=2)
_SIMULATED = LineStyle(colour("vermillion"), (5.0, 1.6), width=1.2, zorder=4)
_ERROR = LineStyle(colour("blue"), width=0.8)


@dataclass(frozen=True)
class SimulatedOutput:
    """A scheduling variable over a record: values (N,) in the unit."""

    name: str
    unit: str
    values: Array


@dataclass(frozen=True)
class Simulated:
    """Measured and simulated outputs (N, m) at t_s (N,), fit in percent and noise RMS (m,).

    `schedule` has the scheduling variables that moved in the record; they are inputs of the
    simulation besides the excitation.
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    t_s: Array
    measured: Array
    simulated: Array
    fit_percent: Array
    floor_rms: Array
    schedule: tuple[SimulatedOutput, ...] = ()


def simulated_outputs(run: Simulated, *, sheet: Sheet = PAGE) -> Figure:
    """Draw the scheduling variables, then each output with its simulation error below.

    Errors have their own scale, with the noise band behind them.
    """
    schedules, outputs = len(run.schedule), len(run.names)
    heights = [_SCHEDULE_IN] * schedules + [_OUTPUT_IN, _ERROR_IN] * outputs
    legend: list[Artist] = [
        entry("measured", _MEASURED),
        entry("simulated", _SIMULATED),
        entry("measured − simulated", _ERROR),
        Patch(color=colour("truth"), alpha=0.3, label="95 % of the noise"),
    ]
    with drawing(sheet):
        grid = new_grid((len(heights), 1), sheet, heights, legend)
        axes = list(grid.axes[:, 0])
        for ax, trace in zip(axes, run.schedule, strict=False):
            factor, prefix = _scale(trace.values, trace.unit)
            plot_envelope(ax, envelope(run.t_s, trace.values, _BINS), _SCHEDULE, factor)
            ax.set_title(trace.name)
            ax.set_title(prefix + trace.unit, loc="right", fontweight="normal")
        for i in range(outputs):
            above, beneath = axes[schedules + 2 * i], axes[schedules + 2 * i + 1]
            _draw_output(above, run, i)
            _draw_error(beneath, run, i)
        for ax in axes:
            ax.margins(x=0)
            ax.tick_params(labelbottom=ax is axes[-1], length=2.5)
        axes[-1].set_xlabel("time [s]")
    return grid.figure


def simulated_side_by_side(
    runs: Sequence[Simulated], titles: Sequence[str], *, sheet: Sheet = PAGE
) -> Figure:
    """Draw a column with a title for each run: what moved, and each output, on the same axes."""
    names, units = runs[0].names, runs[0].units
    heights = [_SCHEDULE_IN] + [_OUTPUT_IN] * len(names)
    legend: list[Artist] = [entry("measured", _MEASURED), entry("simulated", _SIMULATED)]
    with drawing(sheet):
        grid = new_grid((len(heights), len(runs)), sheet, heights, legend)
        for row in range(len(heights)):
            sources = [r.schedule[0].values if row == 0 else r.measured[:, row - 1] for r in runs]
            together = np.concatenate(sources)
            unit = runs[0].schedule[0].unit if row == 0 else units[row - 1]
            scale, limits = _scale(together, unit), _limits(together)
            for ax, run, title in zip(grid.axes[row], runs, titles, strict=True):
                if row == 0:
                    moved = run.schedule[0]
                    plot_envelope(ax, envelope(run.t_s, moved.values, _BINS), _SCHEDULE, scale[0])
                    ax.set_title(f"{moved.name}, {title}")
                else:
                    _draw_curves(ax, run, row - 1, scale[0])
                ax.set_title(scale[1] + _shown(unit), loc="right", fontweight="normal")
                ax.margins(x=0)
                ax.set_ylim(scale[0] * limits[0], scale[0] * limits[1])
                ax.tick_params(labelbottom=row == len(heights) - 1, length=2.5)
        for ax in grid.axes[-1]:
            ax.set_xlabel("time [s]")
    return grid.figure


def _limits(values: Array) -> tuple[float, float]:
    known = values[np.isfinite(values)]
    margin = 0.15 * float(np.ptp(known)) if known.size else 0.0
    return (float(known.min()) - margin, float(known.max()) + margin) if margin else (-1.0, 1.0)


def _draw_output(ax: Axes, run: Simulated, i: int) -> None:
    factor, prefix = _scale(run.measured[:, i], run.units[i])
    _draw_curves(ax, run, i, factor)
    ax.set_title(prefix + _shown(run.units[i]), loc="right", fontweight="normal")
    known = run.measured[:, i][np.isfinite(run.measured[:, i])]
    if known.size and np.ptp(known) > 0:
        # A diverging simulation must not flatten the data.
        ax.set_ylim(*(factor * limit for limit in _limits(run.measured[:, i])))


def _draw_curves(ax: Axes, run: Simulated, i: int, factor: float) -> None:
    measured = envelope(run.t_s, run.measured[:, i], _BINS)
    plot_envelope(ax, measured, _MEASURED, factor)
    if not measured.is_line:  # the simulation's line would hide a thinner band
        middle = factor * (measured.low + measured.high) / 2
        [drawn] = ax.plot(measured.t, middle, **_MEASURED.keywords())
        attach(drawn, ())  # the chart has the band
    thinned = slice(None, None, -(-len(run.t_s) // _POINTS))
    simulated = factor * run.simulated[:, i]
    [drawn] = ax.plot(run.t_s[thinned], simulated[thinned], **_SIMULATED.keywords())
    attach(drawn, min_max_bins(run.t_s, simulated, simulated))
    ax.set_title(f"{symbol(run.names[i])}, fit {run.fit_percent[i]:.2f} %")


def _draw_error(ax: Axes, run: Simulated, i: int) -> None:
    error, band = run.measured[:, i] - run.simulated[:, i], NOISE_BAND * run.floor_rms[i]
    known = np.abs(error[np.isfinite(error)])
    largest = max(float(known.max(initial=0.0)), float(np.nan_to_num(band)))
    factor, prefix = engineering(largest, run.units[i])
    if np.isfinite(band):
        ax.axhspan(-factor * band, factor * band, color=colour("truth"), alpha=0.3, linewidth=0)
    plot_envelope(ax, envelope(run.t_s, error, _BINS), _ERROR, factor)
    ax.set_title(f"{symbol(run.names[i])}, measured − simulated", fontweight="normal")
    ax.set_title(prefix + _shown(run.units[i]), loc="right", fontweight="normal")
    if largest > 0:
        ax.set_ylim(-1.15 * factor * largest, 1.15 * factor * largest)


def _scale(values: Array, unit: str) -> tuple[float, str]:
    return engineering(float(np.max(np.abs(values[np.isfinite(values)]), initial=0.0)), unit)


def _shown(unit: str) -> str:
    return "" if unit == "1" else unit
