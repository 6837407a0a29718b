"""Derive an interactive chart from a drawn figure: every figure module describes a curve once.

Lines, bands and steps become series, spans, reference lines and texts become marks; legend entries
are matched with them by colour, dashes and marker. A figure with other content stays static.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Any

import matplotlib.lines as mlines
import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.axis import Axis as DrawnAxis
from matplotlib.collections import Collection, LineCollection, PolyCollection
from matplotlib.colors import to_hex, to_rgba
from matplotlib.figure import Figure
from matplotlib.legend import Legend
from matplotlib.patches import Patch, StepPatch
from matplotlib.patches import Rectangle as DrawnRectangle
from matplotlib.text import Annotation
from matplotlib.ticker import FixedLocator
from numpy.typing import NDArray

from .chart import Axis, Chart, Entry, Look, Mark, Note, Panel, Rectangle, Segments, Series
from .min_max_bins import Bins, attached
from .style import COLOURS

Array = NDArray[np.float64]

_PX = 96 / 72
"""CSS pixels in a point."""
_ROLES = {colour.light: colour.role for colour in COLOURS}


class _StaticOnlyError(Exception):
    """The figure has content that a chart over x cannot show."""


def chart_of(figure: Figure) -> Chart | None:
    """Return the chart of a figure that was drawn, or None if only the static picture shows it.

    A chart needs panels in a grid, and curves with ascending x in at least one of them.
    """
    try:
        return _chart(figure)
    except _StaticOnlyError:
        return None


def _chart(figure: Figure) -> Chart:
    entries: list[tuple[Entry, Artist]] = []
    common = [k for legend in figure.legends for k in _read_legend(legend, entries)]
    panels = []
    for ax in figure.axes:
        drawn = ax.get_legend()
        own = [] if drawn is None else _read_legend(drawn, entries)
        panels.append(_Reader(figure, ax, entries, [*own, *common]).panel(tuple(own)))
    if not any(len(run.t) > 1 for p in panels for s in p.series for run in s.samples):
        raise _StaticOnlyError
    columns = 1 + max(panel.column for panel in panels)
    return Chart(columns, tuple(e for e, _ in entries), tuple(common), tuple(panels))


def _read_legend(legend: Legend, entries: list[tuple[Entry, Artist]]) -> list[int]:
    """Append the entries of a legend in reading order; return their numbers."""
    found = []
    for handle, text in zip(legend.legend_handles, legend.get_texts(), strict=True):
        if not isinstance(handle, (mlines.Line2D, Patch)):
            raise _StaticOnlyError  # e.g. error bars as a legend entry
        where = text.get_window_extent()
        found.append(((-round(where.y0), round(where.x0)), text.get_text(), handle))
    numbers = []
    for _, label, handle in sorted(found, key=lambda f: f[0]):
        area = isinstance(handle, Patch)
        look = _line_look(handle) if isinstance(handle, mlines.Line2D) else _patch_look(handle)
        numbers.append(len(entries))
        entries.append((Entry(label, look, area), handle))
    return numbers


class _Reader:
    """Reads one pair of axes; raises _StaticOnlyError for content without a counterpart."""

    def __init__(
        self,
        figure: Figure,
        ax: Axes,
        entries: Sequence[tuple[Entry, Artist]],
        candidates: Sequence[int],
    ) -> None:
        self._figure, self._ax = figure, ax
        self._entries, self._candidates = entries, candidates
        self._log = (ax.get_xscale() == "log", ax.get_yscale() == "log")
        if {ax.get_xscale(), ax.get_yscale()} - {"log", "linear"} or ax.get_aspect() != "auto":
            raise _StaticOnlyError
        if ax.images or ax.tables or ax.artists or ax.xaxis_inverted():
            raise _StaticOnlyError

    def panel(self, own_legend: tuple[int, ...]) -> Panel:
        """Return the panel."""
        ax, place = self._ax, self._ax.get_subplotspec()
        if place is None or len(place.rowspan) != 1 or len(place.colspan) != 1:
            raise _StaticOnlyError
        series: list[tuple[float, Series]] = []
        marks: list[tuple[float, Mark]] = []
        for artist in (*ax.lines, *ax.collections, *ax.patches, *ax.texts):
            if not artist.get_visible():
                continue
            found = self._read(artist)
            if isinstance(found, Series):
                series.append((artist.get_zorder(), found))
            elif found is not None:
                marks.append((artist.get_zorder(), found))
        inches = float(ax.get_position().height * self._figure.get_size_inches()[1])
        right = ax.get_title("right")
        x, y = self._axis(ax.xaxis), self._axis(ax.yaxis)
        return Panel(
            row=place.rowspan.start,
            column=place.colspan.start,
            height=96 * inches,
            title=ax.get_title("left"),
            right_title=right,
            x=x,
            y=replace(y, unit=y.unit or _unit(ax.get_title("left"), right)),
            series=tuple(s for _, s in sorted(series, key=lambda item: item[0])),
            marks=tuple(m for _, m in sorted(marks, key=lambda item: item[0])),
            legend=own_legend,
        )

    def _read(self, artist: Artist) -> Series | Mark | None:
        if isinstance(artist, mlines.Line2D):
            return self._line(artist)
        if isinstance(artist, StepPatch):
            return self._steps(artist)
        if isinstance(artist, DrawnRectangle):
            return self._rectangle(artist)
        if isinstance(artist, LineCollection):
            return self._segments(artist)
        if isinstance(artist, PolyCollection):
            return self._band(artist)
        if isinstance(artist, Annotation):
            return self._note(artist)
        raise _StaticOnlyError

    def _line(self, line: mlines.Line2D) -> Series | Mark | None:
        x, y = (np.asarray(values, float) for values in line.get_data(orig=False))
        look = _line_look(line)
        entry = self._entry_of_line(line)
        if line.get_transform() != self._ax.transData:
            x_share, y_share = self._shares(line.get_transform())
            lines = tuple(
                (float(a), float(b), float(c), float(d))
                for (a, b), (c, d) in pairwise(zip(x, y, strict=True))
            )
            return Segments(lines, x_share, y_share, look, entry)
        samples = attached(line)
        if samples is None:
            samples = self._whole(x, y, y)
        if not samples:
            return None
        return Series("line", self._label(entry), entry, look, samples)

    def _band(self, band: PolyCollection) -> Series | None:
        samples = attached(band)
        look = _collection_look(band)
        if samples is not None:
            entry = self._match(lambda e, _: not e.area and e.look.colour == look.colour)
            line = replace(look, width=1.3 * _PX)
            return Series("line", self._label(entry), entry, line, samples) if samples else None
        runs: list[Bins] = []
        for path in band.get_paths():
            v = np.asarray(path.vertices, float)
            n = (len(v) - 3) // 2
            if n < 1 or len(v) != 2 * n + 3:
                raise _StaticOnlyError  # not a polygon of fill_between
            low, high = v[1 : n + 1, 1], v[n + 2 : 2 * n + 2, 1][::-1]
            runs += self._whole(v[1 : n + 1, 0], np.minimum(low, high), np.maximum(low, high))
        entry = self._entry_of_area(band, look)
        return Series("band", self._label(entry), entry, look, tuple(runs)) if runs else None

    def _steps(self, stairs: StepPatch) -> Series:
        values, edges, _ = stairs.get_data()
        look = _patch_look(stairs)
        entry = self._entry_of_area(stairs, look)
        heights = np.append(np.asarray(values, float), np.nan)
        if self._log[1]:  # an empty bin has no height on a logarithmic axis
            heights = np.where(heights > 0, heights, np.nan)
        samples = (Bins(np.asarray(edges, float), heights, heights, 1),)
        return Series("steps", self._label(entry), entry, look, samples)

    def _whole(self, x: Array, low: Array, high: Array) -> tuple[Bins, ...]:
        """Return a curve as it was drawn; points outside of logarithmic axes are left out."""
        here = np.isfinite(x) & ((x > 0) if self._log[0] else True)
        x, low, high = x[here], low[here], high[here]
        if np.any(np.diff(x) < 0):
            raise _StaticOnlyError
        if self._log[1]:
            low, high = (np.where(v > 0, v, np.nan) for v in (low, high))
        return (Bins(x, low, high, 1, kept=True),) if len(x) else ()

    def _rectangle(self, drawn: DrawnRectangle) -> Rectangle:
        x_share, y_share = self._shares(drawn.get_data_transform())
        (x, y), (width, height) = drawn.get_xy(), (drawn.get_width(), drawn.get_height())
        look = _patch_look(drawn)
        hatched = bool(drawn.get_hatch())
        if hatched:
            look = replace(look, colour=_role(drawn.get_edgecolor()))
        entry = None if hatched else self._entry_of_area(drawn, look)
        return Rectangle((x, x + width), (y, y + height), x_share, y_share, look, hatched, entry)

    def _segments(self, drawn: LineCollection) -> Segments:
        look = _collection_look(drawn)
        width = float(np.atleast_1d(drawn.get_linewidth())[0])
        look = replace(look, colour=_role(drawn.get_edgecolor()[0]), width=width * _PX)
        lines = tuple(
            (float(s[0][0]), float(s[0][1]), float(s[-1][0]), float(s[-1][1]))
            for s in drawn.get_segments()
            if len(s)  # a missing value leaves an empty segment
        )
        entry = self._match(lambda e, _: not e.area and e.look.colour == look.colour)
        return Segments(lines, *self._shares(drawn.get_transform()), look, entry)

    def _note(self, drawn: Annotation) -> Note:
        share = {"data": False, "axes fraction": True}
        coords = drawn.xycoords if isinstance(drawn.xycoords, tuple) else (drawn.xycoords,) * 2
        if not all(isinstance(c, str) and c in share for c in coords):
            raise _StaticOnlyError
        if drawn.anncoords not in ("offset points", drawn.xycoords):
            raise _StaticOnlyError
        offset = drawn.xyann if drawn.anncoords == "offset points" else (0.0, 0.0)
        return Note(
            text=drawn.get_text(),
            x=float(drawn.xy[0]),
            y=float(drawn.xy[1]),
            x_share=share[str(coords[0])],
            y_share=share[str(coords[1])],
            dx=float(offset[0]) * _PX,
            dy=float(offset[1]) * _PX,
            horizontal=drawn.get_horizontalalignment(),
            vertical=drawn.get_verticalalignment(),
            rotation=float(drawn.get_rotation()),
            size=float(drawn.get_fontsize()) * _PX,
            bold=str(drawn.get_fontweight()) == "bold",
            colour=_role(drawn.get_color()),
        )

    def _shares(self, transform: Any) -> tuple[bool, bool]:
        """Return whether x, and y, are shares of the panel instead of data."""
        ax = self._ax
        known = (
            (ax.transData, (False, False)),
            (ax.get_xaxis_transform(which="grid"), (False, True)),
            (ax.get_yaxis_transform(which="grid"), (True, False)),
            (ax.transAxes, (True, True)),
        )
        for candidate, shares in known:
            if transform == candidate:
                return shares
        raise _StaticOnlyError

    def _axis(self, axis: DrawnAxis) -> Axis:
        ax, is_x = self._ax, axis is self._ax.xaxis
        low, high = ax.get_xlim() if is_x else ax.get_ylim()
        low, high, inverted = (high, low, True) if high < low else (low, high, False)
        label, unit = _label_and_unit(
            axis.get_label_text() or (self._shared_label() if is_x else "")
        )
        log = self._log[0 if is_x else 1]
        ticks = () if log else _fixed_ticks(axis)
        if ticks and not unit:
            unit = "°" if all(text.endswith("°") for _, text in ticks) else ""
        labelled = bool(axis.get_tick_params().get("labelbottom", True)) if is_x else True
        key = f"{label}|{unit}|{log}|{low:.9g}|{high:.9g}" if is_x else ""
        return Axis(label, unit, low, high, log, inverted, ticks, labelled, key)

    def _shared_label(self) -> str:
        """Return the label of an x axis that another panel of the column bears."""
        siblings = self._ax.get_shared_x_axes().get_siblings(self._ax)
        own = self._ax.get_position().x0
        texts = [s.get_xlabel() for s in siblings if abs(s.get_position().x0 - own) < 1e-6]
        return next((text for text in texts if text), "")

    def _label(self, entry: int | None) -> str:
        return "" if entry is None else self._entries[entry][0].label

    def _entry_of_line(self, line: mlines.Line2D) -> int | None:
        own = (_role(line.get_color()), _dashes(line), str(line.get_marker()))

        def same(part: slice) -> Any:
            return lambda _, h: (
                isinstance(h, mlines.Line2D)
                and ((_role(h.get_color()), _dashes(h), str(h.get_marker()))[part] == own[part])
            )

        exact = self._match(same(slice(0, 3)))
        return self._match(same(slice(0, 1))) if exact is None else exact

    def _entry_of_area(self, artist: Artist, look: Look) -> int | None:
        def same(entry: Entry, handle: Artist) -> bool:
            faces = (_face(artist), _face(handle))
            return entry.area and faces[0] == faces[1]

        exact = self._match(same)
        if exact is not None:
            return exact
        return self._match(lambda e, _: not e.area and e.look.colour == look.colour)

    def _match(self, test: Any) -> int | None:
        return next((k for k in self._candidates if test(*self._entries[k])), None)


def _unit(title: str, right_title: str) -> str:
    """Return the unit of a panel: in brackets behind the title, else the title on the right."""
    _, unit = _label_and_unit(title)
    return unit or ("" if re.search(r"[=:%]", right_title) else right_title)


def _label_and_unit(text: str) -> tuple[str, str]:
    match = re.fullmatch(r"(.*?)\s*\[(.+)\]", text)
    return (match[1], match[2]) if match else (text, "")


def _fixed_ticks(axis: DrawnAxis) -> tuple[tuple[float, str], ...]:
    if not isinstance(axis.get_major_locator(), FixedLocator):
        return ()
    texts = [label.get_text() for label in axis.get_majorticklabels()]
    return tuple(zip(map(float, axis.get_majorticklocs()), texts, strict=False))


def _role(colour: Any) -> str:
    """Return the role of a colour in the palette, or its CSS code."""
    if isinstance(colour, str) and colour in ("none", "auto"):
        return ""
    code = to_hex(colour)
    return _ROLES.get(code, code)


def _dashes(line: mlines.Line2D) -> tuple[float, ...]:
    """Return the dashes in line widths; empty for a solid line."""
    _, dashes = line._unscaled_dash_pattern  # type: ignore[attr-defined]  # no public reader
    return tuple(dashes or ())


def _line_look(line: mlines.Line2D) -> Look:
    marker = str(line.get_marker())
    marker = "" if marker in ("None", "none", " ", "") else marker
    width = (
        0.0 if line.get_linestyle() in ("None", "none", " ", "") else float(line.get_linewidth())
    )
    face = _role(line.get_markerfacecolor()) if marker else ""
    return Look(
        colour=_role(line.get_markeredgecolor() if marker and not width else line.get_color()),
        width=width * _PX,
        dash=tuple(d * float(line.get_linewidth()) * _PX for d in _dashes(line)) if width else (),
        alpha=1.0 if line.get_alpha() is None else float(line.get_alpha() or 0.0),
        marker=marker,
        size=float(line.get_markersize()) * _PX if marker else 0.0,
        filled=face != "paper",
    )


def _patch_look(patch: Patch) -> Look:
    filled = bool(patch.get_fill()) and to_rgba(patch.get_facecolor())[3] > 0
    colour = patch.get_facecolor() if filled else patch.get_edgecolor()
    alpha = patch.get_alpha()
    width = 0.0 if filled else float(patch.get_linewidth()) * _PX
    return Look(_role(colour), width, alpha=1.0 if alpha is None else float(alpha), filled=filled)


def _collection_look(drawn: Collection) -> Look:
    faces = np.atleast_2d(drawn.get_facecolor())
    alpha = drawn.get_alpha()
    colour = _role(faces[0]) if faces.size else ""
    return Look(colour, alpha=1.0 if alpha is None else float(np.atleast_1d(alpha)[0]))


def _face(artist: Artist) -> tuple[str, float] | None:
    """Return colour and opacity of an area, or None for a line."""
    if isinstance(artist, (Patch, Collection)):
        faces = np.atleast_2d(np.asarray(artist.get_facecolor(), float))
        return (to_hex(faces[0][:3]), round(float(faces[0][3]), 3)) if faces.size else None
    return None
