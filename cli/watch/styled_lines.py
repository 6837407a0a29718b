"""Compose lines of styled text to panels: fit, wrap, and place side by side."""

from __future__ import annotations

import re
from collections.abc import Sequence

from rich.cells import cell_len as any_cell_len
from rich.cells import set_cell_size

Span = tuple[str, str]
"""Text and the name of its style, one of STYLES; empty: plain."""
Line = list[Span]

STYLES = {
    "": "",
    "bold": "bold",
    "dim": "dim",
    "title": "bold cyan",
    "good": "green",
    "warning": "yellow",
    "bad": "bold red",
    "alarm": "bold white on red",
    "state": "bold reverse",
    "key": "reverse",
}
"""Styles in the 16 colours of the terminal; what they mean is always also said in text."""


_SINGLE = re.compile("[ -~│─·…±█▏▎▍▌▋▊▉▕⠀-⣿]*")
"""Characters that the screen draws: each takes one cell."""


def cell_len(text: str) -> int:
    """Return the width of a text in cells."""
    return len(text) if _SINGLE.fullmatch(text) else any_cell_len(text)


def width_of(line: Line) -> int:
    """Return the width of a line in cells."""
    return sum(cell_len(text) for text, _ in line)


def fit(line: Line, width: int) -> Line:
    """Return a line of exactly `width` cells: padded, or cut with an ellipsis."""
    found = width_of(line)
    if found <= width:
        return [*line, (" " * (width - found), "")] if found < width else line
    fitted: Line = []
    left = width - 1
    for text, style in line:
        if cell_len(text) >= left:
            fitted.append((set_cell_size(text, max(left, 0)) + ("…" if width else ""), style))
            break
        fitted.append((text, style))
        left -= cell_len(text)
    return fitted


def wrap(text: str, width: int, style: str = "", indent: int = 0, most: int = 0) -> list[Line]:
    """Return a text in lines of at most `width` cells, broken at spaces; at most `most` lines.

    Lines after the first one are indented.
    """
    rows = [""]
    for word in text.split():
        room = width - (indent if len(rows) > 1 else 0)
        if not rows[-1]:
            rows[-1] = word
        elif cell_len(rows[-1]) + 1 + cell_len(word) <= room:
            rows[-1] += f" {word}"
        else:
            rows.append(word)
    if most and len(rows) > most:
        rows[most - 1 :] = [" ".join(rows[most - 1 :])]
    return [[(" " * indent if i else "", ""), (row, style)] for i, row in enumerate(rows)]


def side_by_side(columns: Sequence[tuple[Sequence[Line], int]], gap: int = 2) -> list[Line]:
    """Return columns (lines, width) beside each other, as long as the longest."""
    rows = max((len(lines) for lines, _ in columns), default=0)
    joined: list[Line] = []
    for row in range(rows):
        line: Line = []
        for index, (lines, width) in enumerate(columns):
            if index:
                line.append((" " * gap, ""))
            line += fit(list(lines[row]) if row < len(lines) else [], width)
        joined.append(line)
    return joined


def title(text: str, width: int) -> Line:
    """Return a heading that a rule continues to the right."""
    return fit([(f"{text} ", "title"), ("─" * max(width - cell_len(text) - 1, 0), "dim")], width)


def plain(lines: Sequence[Line]) -> str:
    """Return the text of lines without styles."""
    return "\n".join("".join(text for text, _ in line).rstrip() for line in lines)
