"""Describe an interactive chart: panels with axes, series and marks, as in a drawn figure."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from .min_max_bins import Samples


@dataclass(frozen=True)
class Look:
    """Appearance of a series, mark or legend entry; lengths in CSS pixels.

    `colour` is a role of style.COLOURS or a CSS colour. A series without line has width 0. `marker`
    is matplotlib's code; a marker is filled if `filled`.
    """

    colour: str
    width: float = 0.0
    dash: tuple[float, ...] = ()
    alpha: float = 1.0
    marker: str = ""
    size: float = 0.0
    filled: bool = True


@dataclass(frozen=True)
class Entry:
    """An entry of a legend; `area` if it stands for a band or a coloured area."""

    label: str
    look: Look
    area: bool = False


@dataclass(frozen=True)
class Series:
    """A curve over x, or the band between a lower and an upper curve.

    `kind`: a line; a band, which has a lower and an upper value at each x; steps, filled from the
    bottom of the panel. `entry` is the number of its legend entry, None without.
    """

    kind: Literal["line", "band", "steps"]
    label: str
    entry: int | None
    look: Look
    samples: Samples


@dataclass(frozen=True)
class Rectangle:
    """An area behind the series; a coordinate is in data, or a share of the panel (`*_share`)."""

    x: tuple[float, float]
    y: tuple[float, float]
    x_share: bool
    y_share: bool
    look: Look
    hatched: bool = False
    entry: int | None = None


@dataclass(frozen=True)
class Segments:
    """Straight lines (x0, y0, x1, y1), each behind or in front of the series."""

    lines: tuple[tuple[float, float, float, float], ...]
    x_share: bool
    y_share: bool
    look: Look
    entry: int | None = None


@dataclass(frozen=True)
class Note:
    """A text at a point, displaced by dx, dy pixels (up positive), rotated by degrees."""

    text: str
    x: float
    y: float
    x_share: bool
    y_share: bool
    dx: float
    dy: float
    horizontal: Literal["left", "center", "right"]
    vertical: str
    rotation: float
    size: float
    bold: bool
    colour: str


Mark = Rectangle | Segments | Note


@dataclass(frozen=True)
class Axis:
    """One axis: label, unit, limits, scale, and ticks with texts if the figure fixes these.

    `key` names an axis that several panels have in common: zooming one zooms all.
    """

    label: str
    unit: str
    low: float
    high: float
    log: bool = False
    inverted: bool = False
    ticks: tuple[tuple[float, str], ...] = ()
    labelled: bool = True
    key: str = ""


@dataclass(frozen=True)
class Panel:
    """One pair of axes: place in the grid, height in CSS pixels, texts, content."""

    row: int
    column: int
    height: float
    title: str
    right_title: str
    x: Axis
    y: Axis
    series: tuple[Series, ...]
    marks: tuple[Mark, ...]
    legend: tuple[int, ...] = ()


@dataclass(frozen=True)
class Chart:
    """A figure's panels and legend; `legend` are the entries above all panels, by number."""

    columns: int
    entries: tuple[Entry, ...]
    legend: tuple[int, ...]
    panels: tuple[Panel, ...] = field(repr=False)
