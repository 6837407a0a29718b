"""Find separator, header and units of a text file with columns of numbers."""

from __future__ import annotations

import csv
import itertools
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from datetime import datetime

from ...config.units import known_unit
from .header_units import HeaderCell, header_cell

Row = tuple[int, list[str]]
"""Line number, from 1, and cells without spaces around them."""

MISSING = frozenset({"", "nan", "na", "n/a", "#n/a", "null", "none", "-", "--", "?"})
"""Cells, in lower case, that hold no value."""
_SAMPLE_LINES = 300
_LONGEST_UNIT = 8
"""Most characters of a cell in a header line that holds units."""
_DECIMAL_COMMA = re.compile(r"[-+]?(\d+,\d*|,\d+)([eE][-+]?\d+)?")
_COMMENTS = ("#", "%")


@dataclass(frozen=True)
class TextLayout:
    """Layout of a text file.

    separator: None for white space. cells: the header, None for a file without one. width: cells in
    a row. first_line: line number of the first row of numbers. skipped: number of lines above the
    header that are neither comments nor blank.
    """

    separator: str | None
    cells: tuple[HeaderCell, ...] | None
    width: int
    first_line: int
    skipped: int = 0


def text_layout(file: Iterable[str], *, whitespace: bool) -> TextLayout | None:
    """Return the layout of a text file from its first lines; None for one without rows.

    White space, tabs, semicolons and commas separate columns: the first that splits most lines into
    the same number of cells, with numbers in most of them. `whitespace`: whether white space is
    tried first, else last.
    """
    lines = list(itertools.islice(file, _SAMPLE_LINES))
    separators = (None, "\t", ";", ",") if whitespace else (";", "\t", ",", None)
    default = None if whitespace else ","
    fitting = [s for s in separators if _fits(list(rows(lines, s, strict=False)))]
    good = [s for s in fitting if not _lost_header(list(rows(lines, s, strict=False)))]
    separator = [*good, *fitting, default][0]
    sample = list(rows(lines, separator, strict=False))
    if not sample:
        return None
    start = _first_wide(sample)
    names, units, first = _header(sample[start:])
    found = TextLayout(separator, None, len(sample[start][1]), sample[start][0])
    if not sample[start][1][-1]:
        found = replace(found, width=found.width - 1)
    if names is None:
        comment = _commented_header(lines[: found.first_line - 1], separator)
        cells = comment if len(comment) == found.width else None
        return replace(found, cells=cells, skipped=start)
    first_row = sample[start + first][0] if start + first < len(sample) else len(lines) + 1
    texts = _of_width(sample[start + names][1], found.width)
    below = _of_width([] if units is None else sample[start + units][1], found.width)
    cells = tuple(
        _with_unit(header_cell(text), unit) for text, unit in zip(texts, below, strict=True)
    )
    return replace(found, cells=cells, first_line=first_row, skipped=start + names)


def rows(lines: Iterable[str], separator: str | None, *, strict: bool = True) -> Iterator[Row]:
    """Yield the rows that are neither blank nor comments; strict: open quotes raise csv.Error."""
    if separator is None:
        for number, line in enumerate(lines, 1):
            cells = line.split()
            if cells and not cells[0].startswith(_COMMENTS):
                yield number, _units_joined(cells)
        return
    # A comment becomes a blank line, which keeps the line numbers.
    kept = ("\n" if line.lstrip().startswith(_COMMENTS) else line for line in lines)
    reader = csv.reader(kept, delimiter=separator, skipinitialspace=True, strict=strict)
    for cells in reader:
        stripped = [cell.strip() for cell in cells]
        if any(stripped):
            yield reader.line_num, stripped


def number(cell: str) -> float | None:
    """Return the number in a cell, with a decimal point or comma; None if it is not a number.

    Python takes 1_0 for 10; in a table it is a slip or a name.
    """
    if "_" in cell:
        return None
    try:
        return float(cell)
    except ValueError:
        return float(cell.replace(",", ".")) if _DECIMAL_COMMA.fullmatch(cell) else None


def date(cell: str) -> datetime | None:
    """Return an ISO date, date with time, or time of day; None for other text."""
    for text in (cell, f"1970-01-01T{cell}"):
        try:
            return datetime.fromisoformat(text).replace(tzinfo=None)
        except ValueError:
            continue
    return None


def _fits(sample: Sequence[Row]) -> bool:
    """Return whether a separator splits most rows into equally many cells, most of them numbers."""
    if not sample:
        return False
    (width, count), *_ = Counter(len(cells) for _, cells in sample).most_common(1)
    last = [cells for _, cells in sample if len(cells) == width][-1]
    numeric = sum(_is_value(cell) for cell in last)
    return width >= 2 and 2 * count >= len(sample) and 2 * numeric > width


def _lost_header(sample: Sequence[Row]) -> bool:
    """Return whether the row before the first row of numbers is text with another number of cells.

    White space separates the rows of a file with tabs, too, but splits names with spaces.
    """
    start = _first_wide(sample)
    if start == 0 or not all(map(_is_value, sample[start][1])):
        return False
    return not any(map(_is_number, sample[start - 1][1]))


def _of_width(cells: Sequence[str], width: int) -> list[str]:
    """Return cells of a row, with empty ones at the end if there are too few."""
    return [*cells, *[""] * (width - len(cells))][:width]


def _first_wide(sample: Sequence[Row]) -> int:
    """Return the index of the first row with as many cells as most rows have.

    A separator at the end of the header, or at the end of the other rows, adds no cell.
    """
    (width, _), *_ = Counter(len(cells) for _, cells in sample).most_common(1)
    ends = all(not cells[-1] for _, cells in sample if len(cells) == width)
    for index, (_, cells) in enumerate(sample):
        if len(cells) == width or (len(cells) == width + 1 and not cells[-1]):
            return index
        if ends and width > 2 and len(cells) == width - 1:
            return index
    return 0


def _header(sample: Sequence[Row]) -> tuple[int | None, int | None, int]:
    """Return the indices of the row of names, of the row of units and of the first data row."""
    if all(_is_value(cell) for cell in sample[0][1]):
        return None, None, 0
    everything = (i for i, (_, cells) in enumerate(sample) if all(map(_is_value, cells)))
    anything = (i for i, (_, cells) in enumerate(sample) if i and any(map(_is_number, cells)))
    first = next(everything, next(anything, len(sample)))
    words = [i for i in range(first) if not any(map(_is_number, sample[i][1]))]
    if not words:
        return 0, None, 1
    last = words[-1]
    if last and last - 1 in words and _are_units(sample[last][1]):
        return last - 1, last, last + 1
    return last, None, last + 1


def _are_units(cells: Sequence[str]) -> bool:
    found = [_bare_unit(cell) for cell in cells if cell]
    return any(known_unit(unit) for unit in found) and max(map(len, found)) <= _LONGEST_UNIT


def _bare_unit(cell: str) -> str:
    return cell.strip("[]() ")


def _with_unit(cell: HeaderCell, below: str) -> HeaderCell:
    return replace(cell, unit=_bare_unit(below)) if below else cell


def _commented_header(lines: Sequence[str], separator: str | None) -> tuple[HeaderCell, ...]:
    """Return the cells of the last comment before the first row, as numpy.savetxt writes them."""
    comments = [line.strip() for line in lines if line.lstrip().startswith(_COMMENTS)]
    if not comments:
        return ()
    found = list(rows([comments[-1].lstrip("#% ")], separator))
    return tuple(header_cell(cell) for cell in found[0][1]) if found else ()


def _units_joined(cells: list[str]) -> list[str]:
    """Return words of a line with a unit in brackets joined to the word before it."""
    if not any(cell[0] in "[(" for cell in cells):
        return cells
    joined: list[str] = []
    for cell in cells:
        if joined and cell[0] in "[(" and cell[-1] in "])":
            joined[-1] += f" {cell}"
        else:
            joined.append(cell)
    return joined


def _is_number(cell: str) -> bool:
    return number(cell) is not None


def _is_value(cell: str) -> bool:
    return cell.lower() in MISSING or _is_number(cell) or (cell[0].isdigit() and bool(date(cell)))
