"""Draw the figures of a trace: errors, spectra, candidates, dependence of the residual."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Rectangle
from numpy.typing import NDArray

from ..plotting.labelled_frequency_responses import Range, pooled, symbol
from ..plotting.number_format import signal_text, unit_text
from ..plotting.panel_grid import entry, new_grid
from ..plotting.style import (
    PAGE,
    TRUTH,
    LineStyle,
    Sheet,
    colour,
    drawing,
    log_ticks,
)

Array = NDArray[np.float64]

BEFORE = LineStyle(colour("vermillion"), (5.0, 1.6))
AFTER = LineStyle(colour("blue"))
FLOOR = LineStyle(TRUTH.colour, width=2.4, alpha=0.6, zorder=2)
_LETTER_IN = 0.085
_LABEL_MOST = 56
_ROW_IN = 0.23
_LEAST_SHARE = 0.005
"""Share that is 1 % when rounded; smaller ones have no number."""


@dataclass(frozen=True)
class Bar:
    """A candidate: name, explained share, note, and whether it passed the test and was accepted."""

    name: str
    explained: float
    note: str
    passed: bool
    accepted: bool


def errors_by_record(
    names: Sequence[str],
    dof: Sequence[str],
    before: Array | None,
    after: Array,
    *,
    sheet: Sheet = PAGE,
) -> Figure:
    """Draw errors (R, n) over their noise floor, a row per record and a panel per DOF."""
    both = [after] if before is None else [before, after]
    legend = _dots(before is not None)
    # A diverged simulation has no error to draw.
    after = np.where(np.isfinite(after), after, np.nan)
    known = np.concatenate([b[np.isfinite(b)] for b in both])
    largest = max(float(known.max(initial=0.0)), 2.0)
    limits = (0.5, 1.6 * largest)
    with drawing(sheet):
        grid = new_grid((1, len(dof)), sheet, _ROW_IN * len(names) + 0.75, legend)
        _make_room(grid.figure, names, sheet)
        rows = np.arange(len(names))
        for (_, i), ax in grid.panels():
            ax.axvline(1.0, **FLOOR.keywords())
            if before is not None:
                ax.hlines(rows, after[:, i], before[:, i], color=colour("edge"), linewidth=0.9)
                ax.plot(before[:, i], rows, **_marker(BEFORE, filled=False))
            ax.plot(after[:, i], rows, **_marker(AFTER, filled=True))
            _multiples(ax, limits)
            ax.set_ylim(len(names) - 0.4, -0.6)
            ax.set_yticks(rows, [_cut(n) for n in names] if i == 0 else [""] * len(names))
            ax.set_title(symbol(dof[i]))
            ax.set_xlabel("error / noise")
            ax.tick_params(length=2.5)
            ax.grid(visible=False, axis="y")
    return grid.figure


def error_spectra(
    freq_hz: Array,
    densities: tuple[Array | None, Array, Array],
    names: Sequence[str],
    units: Sequence[str],
    *,
    sheet: Sheet = PAGE,
) -> Figure:
    """Draw densities (F, n) of the error before, after, and of noise, as RMS per root Hz."""
    before, after, floor = densities
    shown = Range(float(freq_hz[freq_hz > 0][0]), float(freq_hz[-1]))
    with drawing(sheet):
        grid = new_grid((1, len(names)), sheet, 2.6, _lines(before is not None))
        for (_, i), ax in grid.panels():
            drawn = []
            for psd, line in ((floor, FLOOR), (before, BEFORE), (after, AFTER)):
                if psd is None:
                    continue
                f, level = pooled(freq_hz, np.sqrt(psd[:, i]), shown)
                visible = (level > 0) & np.isfinite(level)
                ax.plot(f, np.where(visible, level, np.nan), **line.keywords())
                drawn.append(level[visible])
            levels = np.concatenate(drawn)
            if levels.size:
                top = 1.6 * float(levels.max())
                log_ticks(ax, "y", (max(0.6 * float(levels.min()), 1e-6 * top), top))
            ax.set_title(symbol(names[i]))
            ax.set_title(f"{unit_text(units[i]) or '1'}/√Hz", loc="right", fontweight="normal")
        grid.finish_frequency(shown)
    return grid.figure


def candidates(
    bars: Sequence[Bar], measure: str, *, last_tick: float = math.inf, sheet: Sheet = PAGE
) -> Figure:
    """Draw the share that each candidate of a round explains by itself; `measure` is the label.

    Tick labels end at `last_tick`, because shares above 100 % have no meaning.
    """
    legend: list[Artist] = [
        Patch(facecolor=colour("blue"), label="added"),
        Patch(facecolor=colour("sky"), label="passed too"),
        Patch(facecolor=colour("edge"), label="did not pass"),
    ]
    with drawing(sheet):
        grid = new_grid((1, 1), sheet, 0.27 * len(bars) + 0.45, legend)
        ax: Axes = grid.axes[0, 0]
        _make_room(grid.figure, [b.name for b in bars], sheet)
        rows = np.arange(len(bars))
        fill = [
            colour("blue") if b.accepted else colour("sky") if b.passed else colour("edge")
            for b in bars
        ]
        values = np.array([max(b.explained, 0.0) for b in bars])
        ax.barh(rows, values, color=fill, height=0.62)
        reach = max(1.22 * float(values.max(initial=0.0)), 1e-6)
        for row, bar in zip(rows, bars, strict=True):
            ax.annotate(
                bar.note, (max(bar.explained, 0.0), row), (4, 0), textcoords="offset points",
                va="center", fontsize=sheet.font_pt - 1.5, color=colour("muted"),
            )  # fmt: skip
        ax.set_yticks(rows, [_cut(b.name) for b in bars])
        ax.set_ylim(len(bars) - 0.45, -0.55)
        ax.set_xlim(0, reach)
        ax.set_xticks([t for t in ax.get_xticks() if t <= min(last_tick, reach)])
        ax.grid(visible=False, axis="y")
        ax.tick_params(length=2.5)
        ax.set_title(measure, fontweight="normal")
    return grid.figure


def dependence_map(
    dof: Sequence[str],
    signals: Sequence[str],
    before: Array | None,
    after: Array,
    *,
    sheet: Sheet = PAGE,
) -> Figure:
    """Draw shares (n, m) of the residual force that signals explain, as areas of squares."""
    outline: dict[str, Any] = {
        "facecolor": "none",
        "edgecolor": colour("vermillion"),
        "linewidth": 1.4,
    }
    whole = Patch(facecolor=colour("shade"), edgecolor=colour("edge"), label="all of it")
    legend: list[Artist] = [Patch(facecolor=colour("blue"), label="explained"), whole]
    if before is not None:
        legend = [
            Patch(label="without effects", **outline),
            Patch(facecolor=colour("blue"), label="with effects, of the same whole"),
            whole,
        ]
    with drawing(sheet):
        grid = new_grid((1, 1), sheet, 0.42 * len(dof) + 0.95, legend)
        ax: Axes = grid.axes[0, 0]
        ax.grid(visible=False)
        for i in range(len(dof)):
            for j in range(len(signals)):
                _square(ax, j, i, 1.0, facecolor=colour("shade"), edgecolor=colour("grid"))
                _square(ax, j, i, after[i, j], facecolor=colour("blue"), edgecolor="none")
                if before is not None:
                    _square(ax, j, i, before[i, j], **outline)
                    _percent(ax, (j, i), before[i, j], "vermillion", sheet)
                _percent(ax, (j, i), after[i, j], "ink", sheet)
        ax.set_xlim(-0.6, len(signals) - 0.4)
        ax.set_ylim(len(dof) - 0.4, -0.6)
        ax.set_xticks(range(len(signals)), [signal_text(s) for s in signals])
        ax.set_yticks(range(len(dof)), [f"force on {symbol(d)}" for d in dof])
        ax.tick_params(length=0)
        for side in ("left", "bottom"):
            ax.spines[side].set_visible(False)
        _make_room(grid.figure, [f"force on {d}" for d in dof], sheet)
    return grid.figure


def squares_over_time(
    time_s: Sequence[Array],
    before: Sequence[Array] | None,
    after: Sequence[Array],
    *,
    sheet: Sheet = PAGE,
) -> Figure:
    """Draw mean squares of blocks over the session's time, one line segment per record."""
    both = [(after, AFTER)] if before is None else [(before, BEFORE), (after, AFTER)]
    with drawing(sheet):
        grid = new_grid((1, 1), sheet, 2.5, _lines(before is not None))
        ax: Axes = grid.axes[0, 0]
        ax.axhline(1.0, **FLOOR.keywords())
        for values, line in both:
            for t, v in zip(time_s, values, strict=True):
                ax.plot(t, v, **{**line.keywords(), "linewidth": 1.1}, marker="o", markersize=2.2)
        everything = np.concatenate([v for values, _ in both for v in values])
        low, high = float(everything.min()), float(everything.max())
        if high > 5 * low:
            ax.set_yscale("log")
            _multiple_ticks(ax, "y", (min(0.7 * low, 0.7), max(1.5 * high, 2.0)))
        else:
            ax.set_ylim(0.0, max(1.25 * high, 1.5))
        ax.margins(x=0.01)
        ax.set_xlabel("time of the session [s]")
        ax.set_title("mean square of 4 s, in variances of the noise")
        ax.tick_params(length=2.5)
    return grid.figure


def sensors_alone(before: Array | None, after: Array, *, sheet: Sheet = PAGE) -> Figure:
    """Draw each sensor's RMS (S,) outside the rigid-body directions, relative to its noise."""
    both = [after] if before is None else [before, after]
    with drawing(sheet):
        grid = new_grid((1, 1), sheet, 2.3, _dots(before is not None))
        ax: Axes = grid.axes[0, 0]
        x = np.arange(len(after))
        ax.axhline(1.0, **FLOOR.keywords())
        if before is not None:
            ax.vlines(x, after, before, color=colour("edge"), linewidth=0.9)
            ax.plot(x, before, **_marker(BEFORE, filled=False))
        ax.plot(x, after, **_marker(AFTER, filled=True))
        ax.set_xticks(x, [f"sensor {i}" for i in x])
        high = max(float(np.nanmax(b)) for b in both)
        if high > 4:
            ax.set_yscale("log")
            _multiple_ticks(ax, "y", (0.7, 1.5 * high))
        else:
            ax.set_ylim(0.0, max(1.2 * high, 1.4))
        ax.grid(visible=False, axis="x")
        ax.tick_params(length=2.5)
        ax.set_title("beyond the rigid platform, RMS over that of the noise")
    return grid.figure


def _square(ax: Axes, x: float, y: float, share: float, **keywords: Any) -> None:
    """Draw a square with an area of `share` of the cell's."""
    side = 0.84 * float(np.sqrt(np.clip(share, 0.0, 1.0)))
    if side < 0.03:
        return
    ax.add_patch(Rectangle((x - side / 2, y - side / 2), side, side, **keywords))


def _percent(ax: Axes, cell: tuple[int, int], share: float, role: str, sheet: Sheet) -> None:
    """Write a share in percent into a corner of its cell: before above, after below."""
    if share < _LEAST_SHARE:
        return
    upper = role != "ink"
    ax.text(
        cell[0] + (-0.4 if upper else 0.4), cell[1] + (-0.4 if upper else 0.4),
        f"{100 * share:.0f}", color=colour(role), fontsize=sheet.font_pt - 2.5, zorder=5,
        ha="left" if upper else "right", va="top" if upper else "bottom",
    )  # fmt: skip


def _dots(two: bool) -> list[Artist]:
    """Return the legend of dots for one model, or for the models without and with effects."""
    noise = entry("noise alone", FLOOR)
    if not two:
        return [_dot("the model", AFTER, filled=True), noise]
    return [
        _dot("without effects", BEFORE, filled=False),
        _dot("with effects", AFTER, filled=True),
        noise,
    ]


def _lines(two: bool) -> list[Artist]:
    """Return the legend of lines for one model, or for the models without and with effects."""
    noise = entry("noise alone", FLOOR)
    if not two:
        return [entry("the model", AFTER), noise]
    return [entry("without effects", BEFORE), entry("with effects", AFTER), noise]


def _dot(label: str, line: LineStyle, *, filled: bool) -> Line2D:
    return Line2D([], [], label=label, **_marker(line, filled=filled))


def _marker(line: LineStyle, *, filled: bool) -> dict[str, Any]:
    return {
        "linestyle": "none",
        "marker": "o",
        "markersize": 4.6,
        "markeredgewidth": 1.2,
        "markeredgecolor": line.colour,
        "markerfacecolor": line.colour if filled else colour("paper"),
        "zorder": 4 if filled else 3.5,
    }


def _multiples(ax: Axes, limits: tuple[float, float]) -> None:
    ax.set_xscale("log")
    _multiple_ticks(ax, "x", limits)


def _multiple_ticks(ax: Axes, which: str, limits: tuple[float, float]) -> None:
    """Label a logarithmic axis with 1, 2, 5, 10, ..., or fewer numbers if too dense."""
    decades = np.log10(limits[1] / limits[0])
    steps = (1, 2, 5) if decades < 2 else (1,)
    ticks = [float(f"{m}e{e}") for e in range(-1, 7) for m in steps]
    ticks = [t for t in ticks if limits[0] <= t <= limits[1]]
    axis = ax.xaxis if which == "x" else ax.yaxis
    (ax.set_xlim if which == "x" else ax.set_ylim)(*limits)
    axis.set_ticks(ticks, [f"{t:g}" for t in ticks])
    axis.set_ticks([], minor=True)


def _cut(label: str) -> str:
    """Return a label with its middle omitted if it is wider than half of the figure."""
    if len(label) <= _LABEL_MOST:
        return label
    return f"{label[: _LABEL_MOST // 2].rstrip()} … {label[3 - _LABEL_MOST // 2 :].lstrip()}"


def _make_room(figure: Figure, labels: Sequence[str], sheet: Sheet) -> None:
    """Move the axes to the right of the longest label."""
    longest = max((len(_cut(label)) for label in labels), default=0)
    room = 0.2 + _LETTER_IN * sheet.font_pt / 9.5 * longest
    figure.subplots_adjust(left=min(room / sheet.width_in, 0.55))
