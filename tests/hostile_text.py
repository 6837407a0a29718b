"""Texts that break out of the language that they are written into, and checks that they did not."""

from __future__ import annotations

import re
import xml.etree.ElementTree as Xml
from html.parser import HTMLParser

MARK = "Mallory"
"""A word of every hostile text, by which it is found again."""
STEERING = {
    "line break": f"a\n{MARK}: forged\nuser=root",
    "carriage return": f"a\r{MARK}",
    "escape sequence": f"\x1b[2J\x1b]0;{MARK}\x07",
    "C1 escape": f"\x9b2J{MARK}",
    "line separator": f"a\u2028{MARK}: forged",
    "next line": f"a\x85{MARK}: forged",
    "bidirectional": f"\u202e{MARK}\u2066",
    "half a surrogate pair": f"\ud800{MARK}",
    "zero": f"a\0{MARK}",
}
"""Texts that steer a terminal or break a line."""
PRINTABLE = {
    "HTML": f"</style></script></title><script>{MARK}()</script><!--",
    "attribute": f'" onload="{MARK}()" style="x:url(#{MARK})" d="{MARK}" id=\'{MARK}',
    "CSS": f'style="}} * {{ {MARK}: none }}"',
    "shell": f"$(touch {MARK}) `touch {MARK}` ; touch {MARK} & ${{IFS}} '{MARK}",
    "option": f"--out={MARK}",
    "systemd": f'%n %h %%i "{MARK}" ${{{MARK}}}',
    "mathtext": rf"$\frac{{{MARK}$ \undefined_{{",
    "braces": f"{{{MARK}}} {{0}} {{}} %(x)s %s",
    "markup": f"[bold]{MARK}[/nothing] [red",
    "JSON": f'"}}]}} \\ \\u0000 {MARK}',
    "long": f"a{MARK * 1500}",
    "right to left": f"שלום {MARK}",
}
"""Texts that print, and mean something in another language."""
HOSTILE = {**STEERING, **PRINTABLE}
_CONTROL = re.compile(
    "[\x00-\x08\x0b-\x1f\x7f-\x9f\u2028\u2029\u202a-\u202e\u2066-\u2069\ud800-\udfff]"
)
_EMPTY = frozenset({"meta", "link", "br", "input", "img", "hr"})


def check_printed(text: str) -> None:
    """Check that a terminal or log shows a text as it is, and that no line of it is forged."""
    assert not _CONTROL.search(text), ascii(text)
    assert "Traceback" not in text, text
    assert not [line for line in text.splitlines() if line.startswith(MARK)], text


class _Page(HTMLParser):
    """Read a page strictly: every element is closed in order; nothing of it is a hostile text."""

    def __init__(self) -> None:
        super().__init__(convert_charrefs=True)
        self.open: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        assert re.fullmatch(r"[a-z][a-z0-9:]*", tag), tag
        for name, value in attrs:
            assert re.fullmatch(r"[a-z][a-z0-9:-]*", name), (tag, name)
            assert not name.startswith("on"), (tag, name)
            if MARK in (value or ""):
                assert name in ("aria-label", "title", "alt"), (tag, name, value)
        if tag not in _EMPTY:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.handle_starttag(tag, attrs)
        if tag not in _EMPTY:
            self.open.pop()

    def handle_endtag(self, tag: str) -> None:
        assert self.open, tag
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if self.open and self.open[-1] in ("style", "script"):
            assert MARK not in data, data[:200]

    def handle_comment(self, data: str) -> None:
        assert MARK not in data

    def handle_decl(self, decl: str) -> None:
        assert MARK not in decl


def check_page(text: str) -> None:
    """Check that HTML is well-formed and contains hostile texts as text only."""
    assert not _CONTROL.search(text), ascii(_CONTROL.search(text))
    page = _Page()
    page.feed(text)
    page.close()
    assert not page.open, page.open


def check_svg(text: str) -> None:
    """Check that an SVG is XML and contains hostile texts as text only."""
    for element in Xml.fromstring(text).iter():
        assert MARK not in element.tag
        assert not [name for name, value in element.attrib.items() if MARK in name + value]
        if element.tag.endswith("style"):
            assert MARK not in (element.text or "")
