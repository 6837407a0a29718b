"""Draw the shape of an effect, measured and fitted, over a signal and over time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from ...identification.subspace.response_uncertainty import SURE_95
from ..plotting.number_format import signal_text, unit_text
from ..plotting.panel_grid import entry
from ..plotting.style import PAGE, LineStyle, Sheet, colour, drawing, engineering, new_figure

Array = NDArray[np.float64]

_FITTED = LineStyle(colour("vermillion"), width=1.2, zorder=3.2)
_OVER_TIME = LineStyle(
    colour("sky"), width=3.4, zorder=3
)  # shows on both sides where the fit covers it
_SHAPE_IN = 2.7


@dataclass(frozen=True)
class Shape:
    """A part of an effect over a signal (K,): measured with errors, and fitted.

    Also a time span of a record: time_s, measured and fitted (L,).
    """

    title: str
    unit: str
    over: str
    over_unit: str
    at: Array
    measured: Array
    error: Array
    fitted: Array
    stretch: str
    time_s: Array
    stretch_measured: Array
    stretch_fitted: Array


def effect_shapes(shapes: Sequence[Shape], *, sheet: Sheet = PAGE) -> Figure:
    """Draw each part of an effect over the signal that it depends on, and over time."""
    legend: list[Artist] = [
        Line2D(
            [], [], color=colour("blue"), marker="o", markersize=3.5, linestyle="none",
            label="measured, 95 % intervals",
        ),
        entry("fitted effect", _FITTED),
        entry("measured, over time", _OVER_TIME),
    ]  # fmt: skip
    with drawing(sheet):
        height = _SHAPE_IN * len(shapes) + 0.35
        figure = new_figure(sheet, height)
        axes = figure.subplots(len(shapes), 2, squeeze=False)
        figure.subplots_adjust(
            left=0.6 / sheet.width_in, right=1 - 0.22 / sheet.width_in, top=1 - 0.62 / height,
            bottom=0.52 / height, wspace=0.16, hspace=0.48,
        )  # fmt: skip
        figure.legend(
            handles=legend, loc="upper left", bbox_to_anchor=(0.0, 1 - 0.02 / height), ncols=3,
            borderaxespad=0.0,
        )  # fmt: skip
        for shape, (left, right) in zip(shapes, axes, strict=True):
            _draw_shape(left, shape)
            _draw_stretch(right, shape)
    return figure


def _draw_shape(ax: Axes, shape: Shape) -> None:
    factor, prefix = engineering(_reach(shape.measured, shape.fitted), shape.unit)
    across, across_prefix = engineering(_reach(shape.at), shape.over_unit)
    x = across * shape.at
    ax.axhline(0, color=colour("edge"), linewidth=0.8, zorder=1)
    ax.plot(x, factor * shape.fitted, **_FITTED.keywords())
    ax.errorbar(
        x, factor * shape.measured, SURE_95 * factor * shape.error, color=colour("blue"),
        fmt="o", markersize=3.2, linewidth=1.0, zorder=4,
    )  # fmt: skip
    ax.set_title(shape.title)
    ax.set_title(prefix + unit_text(shape.unit), loc="right", fontweight="normal")
    unit = across_prefix + unit_text(shape.over_unit)
    ax.set_xlabel(f"{signal_text(shape.over)} [{unit}]" if unit else signal_text(shape.over))
    ax.tick_params(length=2.5, labelbottom=True)
    ax.xaxis.set_major_locator(MaxNLocator(7))


def _draw_stretch(ax: Axes, shape: Shape) -> None:
    factor, prefix = engineering(_reach(shape.stretch_measured, shape.stretch_fitted), shape.unit)
    ax.axhline(0, color=colour("edge"), linewidth=0.8, zorder=1)
    ax.plot(shape.time_s, factor * shape.stretch_measured, **_OVER_TIME.keywords())
    ax.plot(shape.time_s, factor * shape.stretch_fitted, **_FITTED.keywords())
    ax.set_title(f"the same in {shape.stretch}", fontweight="normal")
    ax.set_title(prefix + unit_text(shape.unit), loc="right", fontweight="normal")
    ax.set_xlabel("time of the session [s]")
    ax.margins(x=0)
    ax.tick_params(length=2.5, labelbottom=True)


def _reach(*values: Array) -> float:
    return max((float(np.nanmax(np.abs(v), initial=0.0)) for v in values), default=0.0)
