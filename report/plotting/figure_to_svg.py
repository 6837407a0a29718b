"""Convert figures to reproducible SVG text with the page's colours, and to interactive charts."""

from __future__ import annotations

import io
import re
from dataclasses import dataclass

from matplotlib.figure import Figure
from matplotlib.text import Text

from ...config.escaping import html_text, svg_texts, visible
from .chart import Chart
from .chart_from_figure import chart_of
from .style import COLOURS, PAGE, Sheet, drawing
from .svg_size import smaller_svg


class Svg(str):
    """SVG text of a figure; `chart` is its interactive form, None if it has none."""

    chart: Chart | None = None
    undrawn: str = ""
    """Why the figure could not be drawn; the SVG then says so."""


@dataclass(frozen=True)
class Picture:
    """A figure of the page: file name without ending, SVG, texts.

    The page shows the SVG, and over it the chart if the SVG is of to_svg and has one.
    `alt` is the alternative text, `caption` the caption, `paper` the corresponding figure of the
    paper ('Fig. 9'), if any. A narrow one fits a telephone.
    """

    name: str
    svg: str
    alt: str
    caption: str
    paper: str = ""
    narrow: bool = False

    @property
    def chart(self) -> Chart | None:
        """The figure's interactive form, None without."""
        return self.svg.chart if isinstance(self.svg, Svg) else None

    @property
    def inline(self) -> str:
        """The SVG element with colours as CSS variables and ids unique on the page."""
        body = self.svg[self.svg.index("<svg") :]
        body = re.sub(r'\bid="', f'id="{self.name}-', body)
        body = re.sub(r'(href="#|url\(#)', rf"\g<1>{self.name}-", body)
        body = re.sub(r"\b(fill|stroke): ?(#[0-9a-f]{6})", _variable, body)
        label = html_text(self.alt)
        return f'<svg role="img" aria-label="{label}"{body.removeprefix("<svg")}'


_UNDRAWN = (
    '<svg xmlns="http://www.w3.org/2000/svg" width="600pt" height="30pt" viewBox="0 0 600 30">'
    '<text x="4" y="18" font-size="9" fill="#1d2126">{}</text></svg>\n'
)
_LONGEST = 200
_ROLES = {colour.light: colour.role for colour in COLOURS}


def to_svg(figure: Figure, sheet: Sheet = PAGE) -> Svg:
    """Return what `svg_of` does; if that fails, an SVG with the reason in place of the figure.

    A page is written with all others: fonts, folders and packages of figures fail on some machines,
    and results do not depend on them.
    """
    try:
        return svg_of(figure, sheet)
    except Exception as error:  # noqa: BLE001 - matplotlib raises whatever its parts do
        reason = f"{type(error).__name__}: {error}"
    svg = Svg(_UNDRAWN.format(html_text(f"This figure could not be drawn: {reason}"[:_LONGEST])))
    svg.undrawn = reason
    return svg


def svg_of(figure: Figure, sheet: Sheet = PAGE) -> Svg:
    """Return a figure as an SVG file's text, without date, and with coordinates to 0.1 points.

    Its `chart` is derived from the same lines, bands and marks. Raises any error of matplotlib.
    """
    with drawing(sheet):
        buffer = io.StringIO()
        escape_texts(figure)
        figure.savefig(buffer, format="svg", metadata={"Date": None, "Creator": None})
        chart = chart_of(figure)
    svg = Svg(smaller_svg(svg_texts(buffer.getvalue())))
    svg.chart = chart
    return svg


def escape_texts(figure: Figure) -> None:
    """Escape what no font has a glyph for and no XML may contain, in all texts of a figure."""
    for text in figure.findobj(Text):
        text.set_text(visible(text.get_text()))


def _variable(match: re.Match[str]) -> str:
    what, value = match.groups()
    return f"{what}:var(--{_ROLES[value]})" if value in _ROLES else match.group()
