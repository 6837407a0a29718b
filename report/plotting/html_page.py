"""Write a self-contained HTML report page: static figures with interactive charts over them.

The page is complete without JavaScript. Its own scripts are the only ones that its content
security policy allows.
"""

from __future__ import annotations

import base64
import hashlib
import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Literal

import numpy as np
from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup

from ...config.escaping import visible
from ...config.files.atomic_write import write_file
from ...config.files.folders import make_folder
from ...config.version import __version__
from .chart_encoding import encode_charts
from .figure_to_svg import Picture, Svg
from .min_max_bins import embeds_all_samples
from .style import COLOURS
from .undrawn_figures import undrawn_figures

MOST_BYTES = 1_500_000
"""Largest page without `all_samples`, if its static part and its shortest charts permit."""
_CHART_FILES = (
    *("colours_and_numbers.js", "chart_data.js", "ticks.js", "shared_axis.js"),
    *("marker_shapes.js", "readout_place.js", "panel_view.js", "charts.js"),
)
_UPLOT_FILE = "vendor/uPlot.iife.min.js"
_LICENCE_FILE = "vendor/uPlot-LICENSE.txt"
_STYLE_FILES = ("vendor/uPlot.min.css", "interactive/charts.css")

Verdict = Literal["good", "bad", "none", "doubt"]
"""Rating of a number: good, bad, neither, or not reliable."""


@dataclass(frozen=True)
class Text:
    """A paragraph of plain text; `lead` sets it larger, `note` smaller."""

    text: str
    weight: Literal["lead", "body", "note"] = "body"


@dataclass(frozen=True)
class Figures:
    """The numbers of the summary, each with value, label and rating."""

    numbers: tuple[Number, ...]


@dataclass(frozen=True)
class Number:
    """One number of the summary."""

    value: str
    meaning: str
    verdict: Verdict = "none"


@dataclass(frozen=True)
class Table:
    """A table of text; columns after the first `labels` are numbers, aligned right."""

    caption: str
    head: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    labels: int = 1


@dataclass(frozen=True)
class Steps:
    """A list of next steps: text and command, or an empty command."""

    items: tuple[tuple[str, str], ...]


@dataclass(frozen=True)
class Next:
    """The first of the next steps, below an answer: text and command, or an empty command."""

    text: str
    command: str = ""


Part = Text | Figures | Table | Picture | Steps | Next


@dataclass(frozen=True)
class Section:
    """A heading and its content in order; a folded section shows its heading until it is opened."""

    title: str
    parts: tuple[Part, ...]
    folded: bool = False

    @property
    def anchor(self) -> str:
        """The section's anchor id."""
        return re.sub(r"[^a-z0-9]+", "-", self.title.lower()).strip("-")


def write_report(out_dir: Path, title: str, sections: Sequence[Section]) -> Path:
    """Write index.html and figures/NAME.svg of each picture into `out_dir`; return the page's path.

    An older report in the folder is replaced. Equal sections give equal bytes.

    Raises:
        OSError: the folder cannot be written.
        ValueError: two pictures have one name, or two sections one title.
    """
    pictures = [part for s in sections for part in s.parts if isinstance(part, Picture)]
    _reject_duplicates("picture", [picture.name for picture in pictures])
    _reject_duplicates("section", [section.anchor for section in sections])
    figures = out_dir / "figures"
    make_folder(figures)
    text = render(title, sections)
    undrawn_figures.extend(
        f"{figures / picture.name}.svg: {picture.svg.undrawn}"
        for picture in pictures
        if isinstance(picture.svg, Svg) and picture.svg.undrawn
    )
    for picture in pictures:
        write_file(figures / f"{picture.name}.svg", picture.svg)
    page = out_dir / "index.html"
    write_file(page, text)
    _remove_surplus(figures, [picture.name for picture in pictures])
    return page


def _remove_surplus(figures: Path, names: Sequence[str]) -> None:
    """Remove figures of an older report that the new one lacks, such as effect-3.svg of three."""
    for series in {m[1] for name in names if (m := re.fullmatch(r"(.+-)\d+", name))}:
        for old in figures.glob(f"{series}*.svg"):
            if re.fullmatch(r"\d+", old.stem.removeprefix(series)) and old.stem not in names:
                old.unlink()


def render(title: str, sections: Sequence[Section]) -> str:
    """Return the page's HTML; all text is escaped, the pictures' SVG is inserted unchanged.

    Charts have the resolution that MOST_BYTES allow, or all samples inside `all_samples`.
    """
    pictures = [part for s in sections for part in s.parts if isinstance(part, Picture)]
    charts = {p.name: p.chart for p in pictures if p.chart is not None}
    drawings, classes = _with_classes({p.name: p.inline for p in pictures})
    template = _environment().get_template("page.html")
    facts: dict[str, object] = {
        "title": title,
        "sections": sections,
        "colours": COLOURS,
        "version": __version__,
    }
    scripts = _scripts() if charts else []
    facts |= {
        "drawings": {name: Markup(svg) for name, svg in drawings.items()},
        "classes": Markup(classes),
        "scripts": [Markup(script) for script in scripts],
        "styles": [Markup(_file(name)) for name in _STYLE_FILES] if charts else [],
        "policy": Markup(_content_security_policy(scripts)),
    }
    bare = template.render(**facts, data=dict.fromkeys(charts, ""))
    room = np.inf if embeds_all_samples() else MOST_BYTES - len(bare.encode())
    data = dict(zip(charts, encode_charts(list(charts.values()), room), strict=True))
    return template.render(**facts, data={name: Markup(text) for name, text in data.items()})


def _scripts() -> list[str]:
    """Return uPlot with its licence, which asks for its text in every copy, and the charts."""
    charts = "\n\n".join(_file(f"interactive/{name}") for name in _CHART_FILES)
    return [
        f"/*!\n{_file(_LICENCE_FILE)}\n*/\n{_file(_UPLOT_FILE)}",
        f'(() => {{\n"use strict";\n{charts}\n}})();',
    ]


def _with_classes(drawings: dict[str, str]) -> tuple[dict[str, str], str]:
    """Replace the styles of all figures by classes, which are much shorter; return their rules."""
    names: dict[str, str] = {}

    def named(style: re.Match[str]) -> str:
        return f'class="s{names.setdefault(style[1], str(len(names)))}"'

    short = {name: re.sub(r'\bstyle="([^"]*)"', named, svg) for name, svg in drawings.items()}
    return short, "\n".join(f".s{number} {{ {style} }}" for style, number in names.items())


def _content_security_policy(scripts: Sequence[str]) -> str:
    """Return a policy that allows the page's own scripts, its styles, and no network."""
    hashes = [
        base64.b64encode(hashlib.sha256(script.encode()).digest()).decode() for script in scripts
    ]
    allowed = " ".join(f"'sha256-{text}'" for text in hashes) or "'none'"
    return f"default-src 'none'; script-src {allowed}; style-src 'unsafe-inline'; img-src data:"


@cache
def _file(name: str) -> str:
    """Return a file of the charts; "</" would end the element that it is put into."""
    text = (Path(__file__).parent / name).read_text(encoding="utf-8").strip()
    if "</" in text:
        raise ValueError(f"{name}: expected no '</', which ends the page's script; found one")
    return text


@cache
def _environment() -> Environment:
    environment = Environment(
        loader=FileSystemLoader(Path(__file__).parent),
        autoescape=True,
        undefined=StrictUndefined,
        finalize=_without_controls,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["kind"] = lambda part: type(part).__name__
    environment.filters["tied"] = _tied
    return environment


def _without_controls(value: object) -> object:
    """Return a value for the page; HTML has no control characters, so text shows their escapes."""
    return visible(value) if isinstance(value, str) and not isinstance(value, Markup) else value


def _tied(text: str) -> str:
    """Return text with non-breaking spaces between numbers and units."""
    return re.sub(r"(?<=\d) (?=%|dB\b|k?Hz\b|[mµ]?(?:s|m|N|rad)\b)", "\u00a0", text)


def _reject_duplicates(what: str, names: Sequence[str]) -> None:
    for name in names:
        if names.count(name) > 1:
            raise ValueError(f"expected every {what} to have its own name, found '{name}' twice")
