"""Shorten the paths of an SVG: relative steps, and no vertices that do not show."""

from __future__ import annotations

import re
from collections.abc import Iterator

import numpy as np

Points = list[tuple[int, int]]

_UNITS = 10
"""Steps in a point: a tenth of a point is a seventh of a pixel."""
_TOLERANCE = 2.0
"""Distance in steps by which a line may miss a vertex that is left out, as in style.py."""
_SHORT = 8
"""Paths of up to this many vertices keep hundredths of a point."""


def shorter_path(d: str) -> str:
    """Return path data with fewer characters that look the same."""
    if d.count("L") <= _SHORT or re.search(r"[^MLz\d.\s+-]", d):
        return " ".join(re.sub(r"-?\d+\.\d{3,}", lambda n: short_number(n.group()), d).split())
    return "".join(_subpath(part) for part in re.findall(r"M[^M]*", d))


def short_number(number: str) -> str:
    """Return a number with at most two decimals."""
    text = f"{float(number):.2f}".rstrip("0").rstrip(".")
    return "0" if text == "-0" else text


def _subpath(part: str) -> str:
    closed = part.rstrip().endswith("z")
    numbers = np.array(re.findall(r"-?[\d.]+", part), float).reshape(-1, 2)
    whole = np.rint(_UNITS * numbers).astype(int).tolist()
    points = list(_without_hidden([(x, y) for x, y in whole]))
    (x, y), text = points[0], []
    text.append(f"M{_tenths(x)} {_tenths(y)}" if y >= 0 else f"M{_tenths(x)}{_tenths(y)}")
    before = "l"
    for x_next, y_next in points[1:]:
        for step in (x_next - x, y_next - y):
            number = _tenths(step)
            # "-" begins a number, and so does a second decimal point.
            joins = number[0] == "-" or before == "l" or (number[0] == "." and "." in before)
            text.append(("l" if before == "l" else "" if joins else " ") + number)
            before = number
        x, y = x_next, y_next
    return "".join(text) + ("z" if closed else "")


def _without_hidden(points: Points) -> Iterator[tuple[int, int]]:
    """Yield the first and last point and those that a straight line would miss.

    From each kept point, the directions are tracked that pass within the tolerance of all points
    since; the first point outside of them ends the line.
    """
    anchor = points[0]
    yield anchor
    last, low, high = anchor, None, None
    for point in points[1:]:
        if point == last:
            continue
        if last != anchor and not _between(anchor, point, low, high, last):
            yield last
            anchor, low, high = last, None, None
        low, high = _narrowed(anchor, point, low, high)
        last = point
    if last != anchor:
        yield last


Direction = tuple[float, float]


def _between(
    anchor: tuple[int, int],
    point: tuple[int, int],
    low: Direction | None,
    high: Direction | None,
    last: tuple[int, int],
) -> bool:
    """Return whether the direction to a point is among those allowed, and the line goes on."""
    dx, dy = point[0] - anchor[0], point[1] - anchor[1]
    before = (last[0] - anchor[0], last[1] - anchor[1])
    if dx * before[0] + dy * before[1] <= 0 or dx * dx + dy * dy < before[0] ** 2 + before[1] ** 2:
        return False  # it turns back: the vertex at the turn shows
    above = low is None or low[0] * dy - low[1] * dx >= 0
    return above and (high is None or high[0] * dy - high[1] * dx <= 0)


def _narrowed(
    anchor: tuple[int, int], point: tuple[int, int], low: Direction | None, high: Direction | None
) -> tuple[Direction | None, Direction | None]:
    """Return the allowed directions that also pass within the tolerance of a point."""
    dx, dy = point[0] - anchor[0], point[1] - anchor[1]
    length = float(np.hypot(dx, dy))
    if length <= _TOLERANCE:
        return low, high
    sine = _TOLERANCE / length
    cosine = (1 - sine * sine) ** 0.5
    right = (cosine * dx + sine * dy, cosine * dy - sine * dx)
    left = (cosine * dx - sine * dy, cosine * dy + sine * dx)
    if low is None or low[0] * right[1] - low[1] * right[0] > 0:
        low = right
    if high is None or high[0] * left[1] - high[1] * left[0] < 0:
        high = left
    return low, high


def _tenths(steps: int) -> str:
    """Return a number of tenths as text, such as -.4, 12 or 3.7."""
    whole, rest = divmod(abs(steps), _UNITS)
    sign = "-" if steps < 0 else ""
    if not rest:
        return f"{sign}{whole}"
    return f"{sign}{whole or ''}.{rest}"
