"""Draw residuals of a model: spectra compared with the noise, and their autocorrelation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from ..plotting.labelled_frequency_responses import Range, pooled, symbol
from ..plotting.number_format import chance
from ..plotting.panel_grid import Grid, entry, new_grid
from ..plotting.style import (
    BOUND,
    PAGE,
    TRUTH,
    LineStyle,
    Sheet,
    colour,
    drawing,
    log_ticks,
)

Array = NDArray[np.float64]

_ERROR = LineStyle(colour("blue"))
_FLOOR = LineStyle(TRUTH.colour, width=2.4, alpha=0.6, zorder=2)
_DECADES_MOST = 6.0
_NAME_MOST = 22


@dataclass(frozen=True)
class Residuals:
    """Errors of one record, m outputs.

    error_psd and floor_psd (F, m): one-sided densities at freq_hz (F,) of simulation error and of
    noise. correlation (m, L): autocorrelation of one-step-ahead prediction errors at lags 1 to L;
    99 % of white records stay below `bound` at all lags. p_value (m,): p-values of the whiteness
    test.
    """

    record: str
    freq_hz: Array
    error_psd: Array
    floor_psd: Array
    correlation: Array
    bound: float
    p_value: Array


def residual_spectra(
    residuals: Sequence[Residuals],
    names: Sequence[str],
    units: Sequence[str],
    *,
    sheet: Sheet = PAGE,
) -> Figure:
    """Draw spectra of error and noise as RMS per root Hz, a row per record, a column per output.

    More than 60 lines per decade are pooled by their RMS.
    """
    shown = Range(
        min(_first(r.freq_hz) for r in residuals), max(float(r.freq_hz[-1]) for r in residuals)
    )
    legend: list[Artist] = [entry("error of the simulation", _ERROR)]
    if any(np.isfinite(r.floor_psd).any() for r in residuals):  # not all records tell noise apart
        legend.append(entry("noise alone", _FLOOR))
    with drawing(sheet):
        grid = new_grid((len(residuals), len(names)), sheet, 1.9, legend)
        for (row, i), ax in grid.panels():
            drawn = []
            for psd, line in (
                (residuals[row].floor_psd, _FLOOR),
                (residuals[row].error_psd, _ERROR),
            ):
                f, level = pooled(residuals[row].freq_hz, np.sqrt(psd[:, i]), shown)
                ax.plot(f, np.where(level > 0, level, np.nan), **line.keywords())
                drawn.append(level)
            _scale(ax, np.concatenate(drawn))
            unit = units[i] if units[i] not in ("", "1") else "1"
            ax.set_title(f"{unit}/√Hz", loc="right", fontweight="normal")
        _name(grid, residuals, names)
        grid.finish_frequency(shown)
    return grid.figure


def residual_correlation(
    residuals: Sequence[Residuals], names: Sequence[str], *, sheet: Sheet = PAGE
) -> Figure:
    """Draw the autocorrelation of one-step-ahead errors in % over the lag, with its bound."""
    legend: list[Artist] = [
        entry("autocorrelation, %", _ERROR),
        entry("99 % of white records stay within", BOUND),
    ]
    with drawing(sheet):
        grid = new_grid((len(residuals), len(names)), sheet, 1.5, legend)
        for (row, i), ax in grid.panels():
            r = residuals[row]
            rho = 100 * r.correlation[i]
            ax.vlines(np.arange(1, len(rho) + 1), 0, rho, color=_ERROR.colour, linewidth=1.8)
            ax.axhline(0, color=colour("edge"), linewidth=0.8, zorder=1)
            for bound in (-100 * r.bound, 100 * r.bound):
                ax.axhline(bound, **BOUND.keywords())
            reach = 1.15 * float(np.nanmax(np.abs(rho), initial=150 * r.bound))
            ax.set_ylim(-reach, reach)
            ax.set_xlim(0, len(rho) + 1)
            ax.set_title(f"p = {chance(r.p_value[i])}", loc="right", fontweight="normal")
            ax.tick_params(labelbottom=row == len(residuals) - 1, length=2.5)
            if row == len(residuals) - 1:
                ax.set_xlabel("lag [samples]")
        _name(grid, residuals, names)
    return grid.figure


def _name(grid: Grid, residuals: Sequence[Residuals], names: Sequence[str]) -> None:
    for (row, i), ax in grid.panels():
        ax.set_title(symbol(names[i]))
        if i == 0:
            record = residuals[row].record
            ax.set_ylabel(record if len(record) <= _NAME_MOST else record[: _NAME_MOST - 1] + "…")


def _first(freq_hz: Array) -> float:
    return float(freq_hz[min(1, len(freq_hz) - 1)])


def _scale(ax: Axes, drawn: Array) -> None:
    values = drawn[np.isfinite(drawn) & (drawn > 0)]
    top = float(values.max()) if values.size else 1.0
    bottom = float(values.min()) if values.size else 0.1
    log_ticks(ax, "y", (max(bottom / 2, top / 10**_DECADES_MOST), 2 * top))
