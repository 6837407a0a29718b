"""Test the report page: complete, self-contained, escaped, reproducible."""

from __future__ import annotations

import base64
import hashlib
import re
from html.parser import HTMLParser
from pathlib import Path
from xml.etree import ElementTree

import matplotlib as mpl
import numpy as np
import pytest

from levid.report.plotting.figure_to_svg import Picture, to_svg
from levid.report.plotting.html_page import (
    Figures,
    Number,
    Section,
    Steps,
    Table,
    Text,
    render,
    write_report,
)
from levid.report.plotting.style import COLOURS, PAGE, drawing, new_figure

NASTY = '<script>alert("x")</script> & "quoted" $\\alpha$ #ffffff'


def figure(title="plain"):
    with drawing():
        drawn = new_figure(PAGE, 2.0)
        ax = drawn.subplots()
        ax.plot(np.arange(50.0), np.sin(np.arange(50.0)), color=COLOURS[7].light, label="curve")
        ax.set_title(title)
        ax.legend()
    return drawn


def picture(name="one", title="plain"):
    return Picture(name, to_svg(figure(title)), f"alt of {title}", f"caption of {title}", "Fig. 9")


def sections(text="text", title="plain"):
    return (
        Section("Summary", (Text(text, "lead"), Figures((Number("9", text, "good"),)))),
        Section("The plant", (picture("one", title), picture("two", title))),
        Section("Records", (Table(text, ("record", "x"), ((text, "1"),)),)),
        Section("What next", (Steps(((text, text),)),)),
    )


class Strict(HTMLParser):
    """Collects ids, references and open tags of a page."""

    VOID = ("meta", "br", "link", "img", "hr")

    def __init__(self):
        super().__init__()
        self.open, self.ids, self.references, self.scripts = [], [], [], []
        self.policy = ""

    def handle_starttag(self, tag, attrs):
        if tag not in self.VOID:
            self.open.append(tag)
        if tag == "script":
            self.scripts.append([dict(attrs).get("type", ""), ""])
        if dict(attrs).get("http-equiv") == "Content-Security-Policy":
            self.policy = dict(attrs)["content"]
        for name, value in attrs:
            if name == "id":
                self.ids.append(value)
            if name in ("href", "src", "xlink:href"):
                self.references.append(value)

    def handle_startendtag(self, tag, attrs):
        self.handle_starttag(tag, attrs)
        self.handle_endtag(tag)

    def handle_data(self, data):
        if self.open and self.open[-1] == "script":
            self.scripts[-1][1] += data

    def handle_endtag(self, tag):
        assert self.open.pop() == tag


def parsed(page):
    parser = Strict()
    parser.feed(page)
    parser.close()
    return parser


def test_every_section_and_every_part_is_on_the_page():
    page = render("The title", sections())
    for expected in ("The title", "Summary", "The plant", "Records", "What next", "Fig. 9"):
        assert expected in page
    parser = parsed(page)
    assert parser.open == []
    for anchor in ("summary", "the-plant", "records", "what-next"):
        assert anchor in parser.ids
        assert f"#{anchor}" in parser.references


def test_page_is_self_contained():
    """All references are within the page or to the figures beside it."""
    page = render("Title", sections())
    parser = parsed(page)
    assert all(r.startswith(("#", "figures/")) for r in parser.references)
    assert not re.search(r"@import|url\((?!#)", page)
    # The only addresses are names of XML namespaces and uPlot's, none is downloaded.
    addresses = set(re.findall(r"https?://[^\s\"'<>)]+", page))
    namespaces = {"http://www.w3.org/2000/svg", "http://www.w3.org/1999/xlink"}
    assert addresses <= namespaces | {"https://github.com/leeoniya/uPlot"}


def test_content_security_policy_allows_the_scripts_of_the_page_only():
    parser = parsed(render("Title", sections()))
    assert "default-src 'none'" in parser.policy
    allowed = set(re.findall(r"'sha256-([^']+)'", parser.policy))
    run = [text for kind, text in parser.scripts if kind != "application/octet-stream"]
    assert len(run) == 2
    assert "MIT License" in run[0]
    hashes = {base64.b64encode(hashlib.sha256(text.encode()).digest()).decode() for text in run}
    assert hashes == allowed


def test_page_without_charts_has_no_script():
    parser = parsed(render("Title", sections()[:1]))
    assert parser.scripts == []
    assert "script-src 'none'" in parser.policy


def test_ids_of_all_figures_are_unique():
    ids = parsed(render("Title", sections())).ids
    assert len(ids) == len(set(ids))


def test_references_inside_a_figure_refer_to_its_own_parts():
    parser = parsed(render("Title", sections()))
    local = {r[1:] for r in parser.references if r.startswith("#")}
    assert local <= set(parser.ids)


def test_text_from_logs_is_escaped_everywhere():
    page = render(NASTY, sections(NASTY, NASTY))
    assert "<script>alert" not in page
    assert page.count("&lt;script&gt;") >= 8  # title twice, text, number, table, steps, figure ...
    assert "$\\alpha$" in page  # a name, not mathematics
    assert parsed(page).open == []


def test_colour_codes_in_text_are_not_replaced():
    inline = picture(title=NASTY).inline
    assert "#ffffff" in inline
    assert "stroke:var(--blue)" in inline


def test_every_figure_has_an_alternative_text():
    page = render("Title", sections())
    assert page.count('role="img" aria-label="alt of plain"') == 2


def test_equal_sections_give_equal_bytes(tmp_path):
    first = write_report(tmp_path / "a", "Title", sections())
    with mpl.rc_context({"lines.linewidth": 7.0, "svg.hashsalt": None, "font.size": 30.0}):
        second = write_report(tmp_path / "b", "Title", sections())
    assert first.read_bytes() == second.read_bytes()
    for name in ("one.svg", "two.svg"):
        one, other = (tmp_path / d / "figures" / name for d in "ab")
        assert one.read_bytes() == other.read_bytes()


def test_figures_beside_the_page_are_complete_svg_files(tmp_path):
    write_report(tmp_path, "Title", sections(title=NASTY))
    text = (tmp_path / "figures" / "one.svg").read_text(encoding="utf-8")
    root = ElementTree.fromstring(text)
    assert root.tag == "{http://www.w3.org/2000/svg}svg"
    assert "var(--" not in text
    assert "date" not in text.lower()


def test_older_report_is_overwritten(tmp_path):
    write_report(tmp_path, "Old", sections())
    page = write_report(tmp_path, "New", sections())
    assert "New" in page.read_text(encoding="utf-8")


def test_two_pictures_of_one_name_are_rejected(tmp_path):
    twice = (Section("A", (picture("same"),)), Section("B", (picture("same"),)))
    with pytest.raises(ValueError, match="'same' twice"):
        write_report(tmp_path, "Title", twice)


def test_drawing_does_not_change_the_settings_of_matplotlib():
    before = dict(mpl.rcParams)
    to_svg(figure())
    assert dict(mpl.rcParams) == before


def test_light_colours_are_distinct():
    assert len({c.light for c in COLOURS}) == len(COLOURS)


@pytest.mark.parametrize("variant", ["light", "dark"])
def test_text_and_lines_have_sufficient_contrast(variant):
    """Contrast by WCAG 2: 7 for text, 4.5 for labels, 3 for the lines of the beam positions."""
    value = {c.role: getattr(c, variant) for c in COLOURS}

    def luminance(colour):
        channels = [int(colour[k : k + 2], 16) / 255 for k in (1, 3, 5)]
        linear = [c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for c in channels]
        return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]

    def contrast(role):
        low, high = sorted((luminance(value[role]), luminance(value["paper"])))
        return (high + 0.05) / (low + 0.05)

    assert contrast("ink") > 7
    assert contrast("muted") > 4.5
    for role in ("blue", "vermillion", "green", "truth"):
        assert contrast(role) > 3


def test_surplus_figures_of_an_older_report_are_removed(
    tmp_path: Path,
) -> None:
    def report(count: int) -> set[str]:
        pictures = [picture(f"effect-{k}") for k in range(1, count + 1)]
        write_report(tmp_path, "title", [Section("Found", tuple(pictures))])
        return {path.name for path in (tmp_path / "figures").iterdir()}

    own = tmp_path / "figures" / "effect-of-mine.svg"
    report(3)
    own.write_text("")
    assert report(1) == {"effect-1.svg", own.name}
