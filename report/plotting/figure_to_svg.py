"""Convert figures to reproducible SVG text with the colours of the page's theme."""

from __future__ import annotations

import io
import re
from dataclasses import dataclass
from html import escape

from matplotlib.figure import Figure

from .style import COLOURS, PAGE, Sheet, drawing

# The layout uses the metrics of DejaVu Sans, which is wider than nearly every other font: labels
# fit with the reader's fonts.
_FONTS = "'DejaVu Sans', Verdana, system-ui, sans-serif"


@dataclass(frozen=True)
class Picture:
    """A figure of the page: file name without ending, SVG, texts.

    `alt` is the alternative text, `caption` the caption, `paper` the corresponding figure of the
    paper ('Fig. 9'), if any.
    """

    name: str
    svg: str
    alt: str
    caption: str
    paper: str = ""

    @property
    def inline(self) -> str:
        """The SVG element with colours as CSS variables and ids unique on the page."""
        body = self.svg[self.svg.index("<svg") :]
        body = re.sub(r'\bid="', f'id="{self.name}-', body)
        body = re.sub(r'(href="#|url\(#)', rf"\g<1>{self.name}-", body)
        body = re.sub(r"\b(fill|stroke): (#[0-9a-f]{6})", _variable, body)
        label = escape(self.alt, quote=True)
        return body.replace("<svg", f'<svg role="img" aria-label="{label}"', 1)


_ROLES = {colour.light: colour.role for colour in COLOURS}


def to_svg(figure: Figure, sheet: Sheet = PAGE) -> str:
    """Return a figure as an SVG file's text, without date, and with coordinates to 0.01 points."""
    with drawing(sheet):
        buffer = io.StringIO()
        figure.savefig(buffer, format="svg", metadata={"Date": None, "Creator": None})
    text = buffer.getvalue()
    text = re.sub(r"<metadata>.*?</metadata>\s*", "", text, flags=re.DOTALL)
    text = re.sub(r"<!--.*?-->\s*", "", text, flags=re.DOTALL)
    text = re.sub(r'\bd="([^"]*)"', _shorter_path, text)
    text = re.sub(r'\b(x|y|width|height)="(-?\d+\.\d{3,})"', _shorter_attribute, text)
    return text.replace("'DejaVu Sans'", _FONTS)


def _variable(match: re.Match[str]) -> str:
    what, value = match.groups()
    return f"{what}: var(--{_ROLES[value]})" if value in _ROLES else match.group()


def _shorter_path(match: re.Match[str]) -> str:
    numbers = re.sub(r"-?\d+\.\d{3,}", lambda n: _short(n.group()), match.group(1))
    return f'd="{" ".join(numbers.split())}"'


def _shorter_attribute(match: re.Match[str]) -> str:
    return f'{match.group(1)}="{_short(match.group(2))}"'


def _short(number: str) -> str:
    text = f"{float(number):.2f}".rstrip("0").rstrip(".")
    return "0" if text == "-0" else text
