"""Draw bars against a limit and charts of recent ranges with block characters."""

from __future__ import annotations

from collections.abc import Sequence

from .styled_lines import Line, Span
from .view import Range

NEAR = 0.8
"""Part of a limit from which a value is shown as near to it."""
_EIGHTHS = " ▏▎▍▌▋▊▉"
_DOTS = ((0x01, 0x08), (0x02, 0x10), (0x04, 0x20), (0x40, 0x80))
"""Bits of a Braille character by row and column."""


def style_of(part: float, applies: bool = True) -> str:
    """Return the style of a value that is this part of its limit; plain if no limit applies now."""
    if not applies:
        return ""
    if part > 1.0:
        return "bad"
    return "warning" if part >= NEAR else "good"


def bar(part: float | None, width: int) -> Line:
    """Return a bar of `width` cells that is full at the limit, with "!" beyond it.

    part: magnitude of the value over its limit; None draws nothing.
    """
    if width < 3:
        return []
    if part is None:
        return [(" " * width, "")]
    inner = width - 1
    eighths = round(min(part, 1.0) * inner * 8)
    full, rest = divmod(eighths, 8)
    text = "█" * full + (_EIGHTHS[rest] if rest else "")
    return [(text.ljust(inner, "·")[:inner], style_of(part)), _end(part)]


def signed_bar(part: float | None, width: int, applies: bool = True) -> Line:
    """Return a bar from the middle to the left or right; its ends are the limit.

    applies: whether the limit applies now; if not, the bar has no colour and no "!".
    """
    half = (width - 3) // 2
    if half < 1:
        return []
    if part is None:
        return [(" " * width, "")]
    filled = min(round(abs(part) * half), half)
    style = style_of(abs(part), applies)
    left, right = (filled, 0) if part < 0 else (0, filled)
    bars = [("·" * (half - left), "dim"), ("█" * left, style), ("│", "dim")]
    bars += [("█" * right, style), ("·" * (half - right), "dim")]
    beyond = applies and abs(part) > 1.0
    start: Span = ("!", "bad") if beyond and part < 0 else ("▕", "dim")
    end: Span = ("!", "bad") if beyond and part > 0 else ("▏", "dim")
    return [start, *bars, end, (" " * (width - 2 * half - 3), "")]


def chart(ranges: Sequence[Range | None], width: int, height: int) -> list[str]:
    """Return rows of Braille characters, with the newest range at the right edge.

    ranges: (smallest, largest) value of each interval; a line of dots joins the two; None is a gap.
    The rows span all of these values. Each character has two intervals side by side.
    """
    shown = list(ranges)[-2 * width :]
    finite = [value for pair in shown if pair is not None for value in pair]
    cells = [[0x2800] * width for _ in range(height)]
    if finite:
        low, high = min(finite), max(finite)
        steps = (4 * height - 1) / ((high - low) or 1.0)
        for index, pair in enumerate(shown, 2 * width - len(shown)):
            if pair is not None:
                lowest, highest = (round((high - value) * steps) for value in pair)
                for level in range(highest, lowest + 1):
                    cells[level // 4][index // 2] |= _DOTS[level % 4][index % 2]
    return ["".join(map(chr, row)) for row in cells]


def _end(part: float) -> Span:
    return ("!", "bad") if part > 1.0 else ("▏", "dim")
