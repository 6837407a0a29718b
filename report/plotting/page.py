"""One page that opens from disk: figures inline, no network, no script; light, dark and printed."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Literal

from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup

from ... import __version__
from .atomic_write import replace_text
from .style import COLOURS
from .svg import Picture

Verdict = Literal["good", "bad", "none", "doubt"]
"""As it should be, not as it should be, neither, or a number that is not to be trusted."""


@dataclass(frozen=True)
class Text:
    """A paragraph of plain text; `lead` sets it larger, `note` smaller."""

    text: str
    weight: Literal["lead", "body", "note"] = "body"


@dataclass(frozen=True)
class Figures:
    """Numbers that say how it went: each a value, what it is, and whether that is good."""

    numbers: tuple[Number, ...]


@dataclass(frozen=True)
class Number:
    """One number of the summary."""

    value: str
    meaning: str
    verdict: Verdict = "none"


@dataclass(frozen=True)
class Table:
    """A table of text; columns beyond the first `labels` are numbers and stand to the right."""

    caption: str
    head: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    labels: int = 1


@dataclass(frozen=True)
class Steps:
    """A list of things to do next: what, and the command that does it (or nothing)."""

    items: tuple[tuple[str, str], ...]


Part = Text | Figures | Table | Picture | Steps


@dataclass(frozen=True)
class Section:
    """A heading and what stands under it, in order."""

    title: str
    parts: tuple[Part, ...]

    @property
    def anchor(self) -> str:
        """The section's id in the page's addresses."""
        return re.sub(r"[^a-z0-9]+", "-", self.title.lower()).strip("-")


def write_report(out_dir: Path, title: str, sections: Sequence[Section]) -> Path:
    """Write index.html and figures/NAME.svg of each picture into `out_dir`; return the page's path.

    An older report there is replaced. Equal sections give equal bytes.

    Raises:
        OSError: the folder cannot be written.
        ValueError: two pictures have one name, or two sections one title.
    """
    pictures = [part for s in sections for part in s.parts if isinstance(part, Picture)]
    _refuse_twins("picture", [picture.name for picture in pictures])
    _refuse_twins("section", [section.anchor for section in sections])
    figures = out_dir / "figures"
    figures.mkdir(parents=True, exist_ok=True)
    text = render(title, sections)
    for picture in pictures:
        replace_text(figures / f"{picture.name}.svg", picture.svg)
    page = out_dir / "index.html"
    replace_text(page, text)
    _remove_surplus(figures, [picture.name for picture in pictures])
    return page


def _remove_surplus(figures: Path, names: Sequence[str]) -> None:
    """Remove figures of an older report that had more of a series: effect-3 where there are two."""
    for series in {m[1] for name in names if (m := re.fullmatch(r"(.+-)\d+", name))}:
        for old in figures.glob(f"{series}*.svg"):
            if re.fullmatch(r"\d+", old.stem.removeprefix(series)) and old.stem not in names:
                old.unlink()


def render(title: str, sections: Sequence[Section]) -> str:
    """Return the page's HTML; every text is escaped, only the pictures' SVG is taken as it is."""
    return (
        _environment()
        .get_template("page.html")
        .render(title=title, sections=sections, colours=COLOURS, version=__version__)
    )


@cache
def _environment() -> Environment:
    environment = Environment(
        loader=FileSystemLoader(Path(__file__).parent),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["kind"] = lambda part: type(part).__name__
    environment.filters["tied"] = _tied
    environment.filters["svg"] = lambda picture: Markup(picture.inline)
    return environment


def _tied(text: str) -> str:
    """Return text in which no line ends between a number and its unit."""
    return re.sub(r"(?<=\d) (?=%|dB\b|k?Hz\b|[mµ]?(?:s|m|N|rad)\b)", "\u00a0", text)


def _refuse_twins(what: str, names: Sequence[str]) -> None:
    for name in names:
        if names.count(name) > 1:
            raise ValueError(f"expected every {what} to have its own name, found '{name}' twice")
