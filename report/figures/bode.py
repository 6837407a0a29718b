"""Draw Bode diagrams of every input to every output: the paper's Figs. 10 and 12."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from ..plotting.labelled_frequency_responses import (
    CONFIDENCE,
    Curve,
    Range,
    SignalLabels,
    inside,
)
from ..plotting.panel_grid import legend_of, name_panel, new_grid, plot_band, plot_curve
from ..plotting.style import PAGE, Sheet, drawing, log_ticks

Array = NDArray[np.float64]
_Kind = Literal["magnitude", "phase"]

_ROW_IN, _LOWER = 1.95, 0.8
"""Height of a row in inches, and that of a row below another of the same path, over it."""
_DECADES_MOST = 5.5
_DOMINANT = 1.5
_NO_PHASE_DEG = 60.0


def bode_magnitude(
    curves: Sequence[Curve],
    signals: SignalLabels,
    *,
    truth: Sequence[Curve] = (),
    shown: Range,
    sheet: Sheet = PAGE,
) -> Figure:
    """Draw |P| in m x p panels in physical units, the truth as a wide grey line behind the curves.

    All panels span the same number of decades. If the diagonal dominates, panel (i, j) is scaled to
    sqrt(|P_ii| |P_jj|), the magnitude of full coupling, so that noise far below it looks small.
    """
    return _bode(curves, signals, truth, shown, sheet, ("magnitude",))


def bode_phase(
    curves: Sequence[Curve],
    signals: SignalLabels,
    *,
    truth: Sequence[Curve] = (),
    shown: Range,
    sheet: Sheet = PAGE,
) -> Figure:
    """Draw the phase in m x p panels in degrees, from −300 to 60 so that a delay does not wrap.

    A curve with a deviation is omitted at frequencies with a phase uncertainty of 60 degrees or
    more, where it is noise and covers other curves.
    """
    return _bode(curves, signals, truth, shown, sheet, ("phase",))


def bode(
    curves: Sequence[Curve],
    signals: SignalLabels,
    *,
    truth: Sequence[Curve] = (),
    shown: Range,
    sheet: Sheet = PAGE,
) -> Figure:
    """Draw magnitude above phase for each input and output, as bode_magnitude and bode_phase do."""
    return _bode(curves, signals, truth, shown, sheet, ("magnitude", "phase"))


def _bode(
    curves: Sequence[Curve],
    signals: SignalLabels,
    truth: Sequence[Curve],
    shown: Range,
    sheet: Sheet,
    kinds: tuple[_Kind, ...],
) -> Figure:
    """Draw each output in one row of panels for each kind; the upper row has the path as title."""
    curves = [inside(c, shown) for c in curves]
    truth = [inside(c, shown) for c in truth]
    m, p = signals.shape
    rows_in = [_ROW_IN if row == 0 else _LOWER * _ROW_IN for row in range(len(kinds))] * m
    with drawing(sheet):
        grid = new_grid((len(rows_in), p), sheet, rows_in, legend_of(curves, truth, shown))
        limits = _limits([*curves, *truth], signals.shape)
        for (row, j), ax in grid.panels():
            i, place = divmod(row, len(kinds))
            if kinds[place] == "magnitude":
                _magnitude_panel(ax, signals, (i, j), limits[i][j])
            else:
                _phase_panel(ax, "" if place else signals.path(i, j))
            draw = _draw_magnitude if kinds[place] == "magnitude" else _draw_phase
            for curve in (*truth, *curves):
                draw(ax, curve, i, j)
        grid.finish_frequency(shown, curves)
    return grid.figure


def _magnitude_panel(
    ax: Axes, signals: SignalLabels, path: tuple[int, int], limits: tuple[float, float]
) -> None:
    log_ticks(ax, "y", limits)
    name_panel(ax, signals.path(*path), signals.gain_unit(*path))


def _phase_panel(ax: Axes, title: str) -> None:
    ax.set_ylim(-300, 60)
    ax.set_yticks([-270, -180, -90, 0], ["−270°", "−180°", "−90°", "0°"])
    name_panel(ax, title)


def _draw_magnitude(ax: Axes, curve: Curve, i: int, j: int) -> None:
    magnitude = np.abs(curve.response[:, i, j])
    magnitude = np.where(magnitude > 0, magnitude, np.nan)
    plot_curve(ax, curve, magnitude, faint=i != j)
    if curve.deviation is not None:
        spread = CONFIDENCE * curve.deviation[:, i, j]
        # Zero values end below the panel's edge.
        plot_band(ax, curve, np.maximum(magnitude - spread, 1e-3 * magnitude), magnitude + spread)


def _draw_phase(ax: Axes, curve: Curve, i: int, j: int) -> None:
    H = curve.response[:, i, j]
    phase = (np.degrees(np.angle(H)) + 300) % 360 - 300
    spread = np.zeros(len(H))
    if curve.phase_deviation_rad is not None:
        spread = np.degrees(CONFIDENCE * curve.phase_deviation_rad[:, i, j])
    elif curve.deviation is not None:
        with np.errstate(divide="ignore", invalid="ignore"):
            spread = np.degrees(CONFIDENCE * curve.deviation[:, i, j] / np.abs(H))
        spread = np.where(np.isnan(curve.deviation[:, i, j]), 0.0, spread)  # a band too narrow
    phase[~(spread < _NO_PHASE_DEG)] = np.nan
    line = phase.copy()
    line[1:][np.abs(np.diff(phase)) > 180] = np.nan
    plot_curve(ax, curve, line, faint=i != j)
    if curve.deviation is not None:
        plot_band(ax, curve, phase - spread, phase + spread)


def _limits(curves: Sequence[Curve], shape: tuple[int, int]) -> list[list[tuple[float, float]]]:
    """Return the limits of every panel, (low, high)."""
    m, p = shape
    tops, bottoms = np.full((m, p), np.nan), np.full((m, p), np.nan)
    for i in range(m):
        for j in range(p):
            values = np.concatenate([np.abs(c.response[:, i, j]) for c in curves] or [np.ones(1)])
            values = values[np.isfinite(values) & (values > 0)]
            if values.size:
                tops[i, j], bottoms[i, j] = values.max(), np.percentile(values, 0.5)
    scale = np.where(np.isfinite(tops), tops, 1.0)
    if m == p:
        root = np.sqrt(np.diag(scale))
        energy = np.outer(root, root)
        # A coupling larger than the diagonal needs its own scale.
        if np.nanmax(np.where(np.isfinite(tops), tops, 0.0) / energy) < _DOMINANT:
            scale = energy
    up = np.nanmax(np.append(np.log10(tops / scale), 0.0)) + 0.2
    down = np.nanmin(np.append(np.log10(bottoms / scale), -1.0)) - 0.1
    down = max(down, up - _DECADES_MOST)
    return [[(scale[i, j] * 10**down, scale[i, j] * 10**up) for j in range(p)] for i in range(m)]
