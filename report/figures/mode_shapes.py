"""Draw the shapes of modes on the platform, as the sensors see them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from matplotlib.tri import LinearTriInterpolator, Triangulation
from numpy.typing import NDArray

from ...identification.greybox.modes.mode_shapes import ModeShape
from ..plotting.panel_grid import new_grid
from ..plotting.style import PAGE, Sheet, colour, drawing, signed

Array = NDArray[np.float64]

_IN_A_ROW, _ROWS_IN = 3, (2.3, 2.5)
_DEPTH = np.array([0.42, 0.34])
"""How far right and up a step to the back is drawn, over its length."""
_LIFT = 0.32
"""Height at which the largest motion is drawn, over the platform's width."""
_CELLS = 16
_SHADES = LinearSegmentedColormap.from_list(
    "motion", [colour("blue"), "#dfe7ee", colour("vermillion")]
)


@dataclass(frozen=True)
class DrawnShape:
    """A shape with its title."""

    title: str
    shape: ModeShape


def mode_shapes(drawn: Sequence[DrawnShape], *, sheet: Sheet = PAGE) -> Figure:
    """Draw each mode twice: the platform at rest and moved, and its motion at each sensor."""
    columns = min(len(drawn), _IN_A_ROW)
    rows = -(-len(drawn) // columns)
    with drawing(sheet):
        grid = new_grid((2 * rows, columns), sheet, rows * _ROWS_IN)
        for (row, column), ax in grid.panels():
            ax.set_axis_off()
            ax.set_aspect("equal")
            number = row // 2 * columns + column
            if number < len(drawn):
                if row % 2:
                    _draw_plan(ax, drawn[number].shape)
                else:
                    ax.set_title(drawn[number].title)
                    _draw_moved(ax, drawn[number].shape)
    return grid.figure


def _draw_moved(ax: Axes, shape: ModeShape) -> None:
    places = _places(shape)
    rest = _projected(places, np.zeros(len(places)))
    moved = _projected(places, _LIFT * shape.shape)
    for cell, value in _cells(places, shape.shape):
        ax.add_collection(PolyCollection([cell], facecolors=[_shade(value)], edgecolors="none"))
    for edge in _edges(places):
        ax.plot(*_projected(edge, np.zeros(2)).T, color=colour("edge"), lw=0.9, zorder=1.5)
    for below, above, value in zip(rest, moved, shape.shape.tolist(), strict=True):
        ax.plot(*np.stack([below, above]).T, color=colour("muted"), lw=0.8, zorder=4.0)
        ax.plot(*above, "o", ms=4.0, mec=colour("ink"), mfc=_shade(value), zorder=5.0)
    ax.margins(0.04, 0.08)


def _draw_plan(ax: Axes, shape: ModeShape) -> None:
    """Draw the sensors from above, x to the right and y up, with the motion at each."""
    places = _places(shape)
    for edge in _edges(places):
        ax.plot(*edge.T, color=colour("edge"), lw=0.9, zorder=1.5)
    for place, value in zip(places, shape.shape.tolist(), strict=True):
        size = 3.0 + 9.0 * abs(value)
        ax.plot(*place, "o", ms=size, mec=colour("ink"), mew=0.6, mfc=_shade(value))
        ax.annotate(
            signed(value, 2),
            tuple(place),
            xytext=(0, -0.5 * size - 2.0),
            textcoords="offset points",
            ha="center",
            va="top",
            color=colour("ink"),
            fontsize="small",
        )
    ax.margins(0.04, 0.2)


def _places(shape: ModeShape) -> Array:
    """Return the sensors' places (S, 2) over the width of what they span."""
    places = shape.sensors_m - shape.sensors_m.mean(axis=0)
    return np.asarray(places / np.ptp(places, axis=0).max())


def _shade(value: float) -> tuple[float, float, float, float]:
    return _SHADES(0.5 + 0.5 * value)


def _projected(places: Array, height: Array) -> Array:
    """Return the points (K, 2) on the page of places (K, 2), seen from the front and above."""
    x, y = places.T
    return np.stack([x + _DEPTH[0] * y, _DEPTH[1] * y + height], axis=1)


def _cells(places: Array, shape: Array) -> list[tuple[Array, float]]:
    """Return the cells of the moved surface between the sensors, back ones first, with motions."""
    mesh = Triangulation(*places.T)
    motion = LinearTriInterpolator(mesh, shape)
    x, y = (np.linspace(c.min(), c.max(), _CELLS + 1) for c in places.T)
    X, Y = np.meshgrid(x, y)
    Z = np.ma.filled(motion(X, Y), np.nan)
    points = _projected(np.stack([X.ravel(), Y.ravel()], axis=1), _LIFT * Z.ravel())
    points = points.reshape(_CELLS + 1, _CELLS + 1, 2)
    found = []
    for j in range(_CELLS - 1, -1, -1):
        for i in range(_CELLS):
            corners = [(j, i), (j, i + 1), (j + 1, i + 1), (j + 1, i)]
            cell = np.array([points[c] for c in corners])
            value = float(np.mean([Z[c] for c in corners]))
            if np.isfinite(value):
                found.append((cell, value))
    return found


def _edges(places: Array) -> list[Array]:
    """Return the outline of the sensors' rectangle."""
    (left, front), (right, back) = places.min(axis=0), places.max(axis=0)
    corners = np.array([[left, front], [right, front], [right, back], [left, back], [left, front]])
    return [corners[k : k + 2] for k in range(4)]
