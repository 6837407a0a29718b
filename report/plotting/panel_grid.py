"""Grids of panels with a common legend above them and a shared frequency axis."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Rectangle
from numpy.typing import NDArray

from .labelled_frequency_responses import Curve, Range
from .style import PAGE, LineStyle, Sheet, colour, frequency_axis, new_figure

Array = NDArray[np.float64]

_LEGEND_ROW_IN, _TITLE_IN, _BOTTOM_IN, _GAP_IN = 0.22, 0.36, 0.5, 0.36


@dataclass(frozen=True)
class Grid:
    """A figure with its axes (rows, columns)."""

    figure: Figure
    axes: NDArray[np.object_]

    def panels(self) -> Iterator[tuple[tuple[int, int], Axes]]:
        """Yield ((row, column), axes), row by row from the top left."""
        rows, columns = self.axes.shape
        for row in range(rows):
            for column in range(columns):
                ax: Axes = self.axes[row, column]
                yield (row, column), ax

    def finish_frequency(self, shown: Range, curves: Sequence[Curve] = ()) -> None:
        """Scale and label the shared frequency axis, and shade what is above the rigid range.

        Panels in which all `curves` are unreliable are hatched.
        """
        frequency_axis(self.axes[0, 0], (shown.low_hz, shown.high_hz))
        hatched = bool(curves) and all(curve.doubtful for curve in curves)
        for (row, _), ax in self.panels():
            last = row == self.axes.shape[0] - 1
            ax.tick_params(labelbottom=last, length=2.5)
            if last:
                ax.set_xlabel("frequency [Hz]")
            mark_validity(ax, shown)
            if hatched:
                _hatch(ax)


def new_grid(
    shape: tuple[int, int],
    sheet: Sheet,
    row_in: float | Sequence[float],
    legend: Sequence[Artist] = (),
) -> Grid:
    """Return a grid of (rows, columns) panels below a legend; a row is `row_in` inches high."""
    scale = max(sheet.width_in / PAGE.width_in, 0.8)
    heights = [scale * h for h in np.broadcast_to(row_in, shape[0]).tolist()]
    columns = _legend_columns(legend, sheet)
    top = _TITLE_IN + _LEGEND_ROW_IN * -(-len(legend) // columns)
    height = sum(heights) - _GAP_IN + top + _BOTTOM_IN
    figure = new_figure(sheet, height)
    inner = [h - _GAP_IN for h in heights]
    axes = figure.subplots(*shape, sharex=True, squeeze=False, gridspec_kw={"height_ratios": inner})
    figure.subplots_adjust(
        left=0.065 * sheet.font_pt / sheet.width_in,
        right=1 - 0.12 / sheet.width_in,
        top=1 - top / height,
        bottom=_BOTTOM_IN / height,
        wspace=0.24,
        hspace=_GAP_IN * shape[0] / sum(inner),
    )
    if legend:
        figure.legend(
            handles=_row_by_row(legend, columns),
            loc="upper left",
            bbox_to_anchor=(0.0, 1 - 0.02 / height),
            ncols=columns,
            borderaxespad=0.0,
        )
    return Grid(figure, axes)


def _legend_columns(entries: Sequence[Artist], sheet: Sheet) -> int:
    """Return the largest number of legend columns that fits the sheet's width."""
    letter, rest = 0.62 * sheet.font_pt / 72, 5.6 * sheet.font_pt / 72
    widths = [letter * len(str(e.get_label())) + rest for e in entries]
    for columns in range(len(entries), 1, -1):
        if sum(max(widths[c::columns]) for c in range(columns)) < sheet.width_in:
            return columns
    return 1


def _row_by_row(entries: Sequence[Artist], columns: int) -> list[Artist]:
    """Reorder legend entries, which matplotlib fills column by column, for reading by rows."""
    return [e for column in range(columns) for e in entries[column::columns]]


def legend_of(
    curves: Sequence[Curve], truth: Sequence[Curve] = (), shown: Range | None = None
) -> list[Artist]:
    """Return the legend entries of labelled curves, their band, the truth and the range."""
    entries: list[Artist] = [entry(c.label, c.line) for c in curves if c.label]
    if any(c.deviation is not None for c in curves):
        entries.append(Patch(color=colour("muted"), alpha=0.3, label="95 % confidence"))
    if truth:
        entries.append(entry(truth[0].label, truth[0].line))
    if shown is not None and shown.valid_to_hz is not None and shown.valid_to_hz < shown.high_hz:
        rad_s = 2.0 * np.pi * shown.valid_to_hz
        label = f"above {shown.valid_to_hz:.3g} Hz ({rad_s:.3g} rad/s): {shown.beyond}"
        entries.append(Patch(facecolor=colour("shade"), edgecolor=colour("edge"), label=label))
    return entries


def entry(label: str, line: LineStyle) -> Line2D:
    """Return the legend entry of a line."""
    return Line2D([], [], label=label, **line.keywords())


def plot_curve(ax: Axes, curve: Curve, values: Array, faint: bool = False) -> None:
    """Draw one value per frequency, with a thin line if `faint`."""
    keywords = curve.line.keywords()
    if faint:
        keywords |= {"linewidth": 0.75 * curve.line.width, "alpha": 0.8 * curve.line.alpha}
    ax.plot(curve.freq_hz, values, **keywords)


def plot_band(ax: Axes, curve: Curve, low: Array, high: Array) -> None:
    """Draw the band of a curve behind all lines."""
    ax.fill_between(
        curve.freq_hz, low, high, color=curve.line.colour, alpha=0.16, linewidth=0, zorder=1.5
    )


def name_panel(ax: Axes, name: str, unit: str = "") -> None:
    """Write a panel's titles just above its axis, which has no common factor of its tick labels.

    matplotlib would search for this place, which takes a sixth of the drawing.
    """
    ax.set_title(name, y=1.0)
    ax.set_title(unit, loc="right", fontweight="normal", y=1.0)


def _hatch(ax: Axes) -> None:
    """Hatch a panel's background."""
    ax.add_patch(
        Rectangle(
            (0.0, 0.0),
            1.0,
            1.0,
            transform=ax.transAxes,
            hatch="//",
            fill=False,
            linewidth=0,
            edgecolor=colour("grid"),
            zorder=0.5,
        )
    )


def mark_validity(ax: Axes, shown: Range) -> None:
    """Shade the frequencies above the range of the rigid-body model."""
    if shown.valid_to_hz is not None and shown.low_hz < shown.valid_to_hz < shown.high_hz:
        ax.axvspan(shown.valid_to_hz, shown.high_hz, color=colour("shade"), zorder=0, linewidth=0)
        ax.axvline(shown.valid_to_hz, color=colour("edge"), linewidth=0.8, zorder=1)
