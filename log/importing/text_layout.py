"""Find the table in a text file: separator, rows of numbers, header, units and further entries.

No format is known by name. The table is the largest block of rows with numbers in the same columns;
the lines above it are searched for names, units and entries such as the sampling interval.
"""

from __future__ import annotations

import csv
import itertools
import math
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

from ...config.units import known_unit
from .header_units import HeaderCell, header_cell, header_unit
from .number_cells import ANY_FORMAT, Proof, is_missing, sign_meaning, with_unit
from .time_cells import stamp

Row = tuple[int, list[str]]
"""Line number, from 1, and cells without spaces around them."""

_SAMPLE_LINES = 500
_LONGEST_UNIT = 12
"""Most characters of a cell in a header line that holds units."""
_FIRST = frozenset("+-.,")
"""Characters, beside digits, that begin a number."""
_COMMENTS = ("#", "%")
_HEADER_LINES = 8
"""Most lines above the first row of numbers that may hold names or units of the columns."""
_AHEAD = 10
"""Rows after the first one of a table that are mostly rows of numbers too."""
_SPARSE = 0.05
"""Least share of the rows in which a column has a number."""
_FILLED = 0.6
"""Least share of the columns for which a header line has a text."""


@dataclass(frozen=True)
class TextLayout:
    """Layout of a text file.

    separator: None for white space. cells: the header, None for a file without one. width: cells in
    a row. numeric: indices of the columns with numbers or dates. first_line: line number of the
    first row of numbers. header_lines: cells of the lines that hold names and units; some programs
    repeat them. entries: further names and values above the table, as text. skipped: number of
    lines above the header that are neither comments nor blank. signs: points and commas in numbers
    of the first rows, and what they must be.
    """

    separator: str | None
    cells: tuple[HeaderCell, ...] | None
    width: int
    numeric: tuple[int, ...]
    first_line: int
    header_lines: tuple[tuple[str, ...], ...] = ()
    entries: tuple[tuple[str, str], ...] = ()
    skipped: int = 0
    signs: tuple[tuple[str, Proof], ...] = ()


@dataclass(frozen=True)
class _Table:
    """The rows of a sample that a separator gives, and where the table is in them."""

    separator: str | None
    sample: list[Row]
    start: int
    width: int
    numeric: tuple[int, ...]
    values: float

    @property
    def named(self) -> bool:
        """Whether the line above the table has a cell for each column, or there is none."""
        above = self.sample[self.start - 1][1] if self.start else None
        return above is None or len(_trimmed(above)) in (self.width, self.width + 1)


def text_layout(file: Iterable[str], *, whitespace: bool) -> TextLayout | None:
    """Return the layout of a text file from its first lines; None for one without rows.

    White space, tabs, semicolons, commas and bars may separate columns: the separator that gives
    the most numbers is used. `whitespace`: whether white space is preferred to others that give
    as many.
    """
    lines = list(itertools.islice(file, _SAMPLE_LINES))
    separators = ("\t", None, ";", ",", "|") if whitespace else (";", "\t", ",", "|", None)
    tables = [table for s in separators if (table := _table(lines, s)) is not None]
    if not tables:
        return None
    most = max(table.values for table in tables)
    best = [table for table in tables if table.values >= most * (1.0 - 1e-9)]
    table = min(best, key=lambda table: (most > 0.0 and not table.named, -table.width))
    return _with_header(table, lines)


def rows(
    lines: Iterable[str], separator: str | None, *, first: int = 1, strict: bool = True
) -> Iterator[Row]:
    """Yield the rows that are neither blank nor comments, from line number `first` on.

    strict: open quotes raise csv.Error.
    """
    lines = itertools.islice(lines, first - 1, None)
    if separator is None:
        for number, line in enumerate(lines, first):
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
            yield reader.line_num + first - 1, stripped


def is_value(cell: str) -> bool:
    """Return whether a cell holds a number, a number with its unit, or a date."""
    first = cell[:1]
    if first.isascii() and not (first.isdigit() or first in _FIRST):
        return ANY_FORMAT.number(cell) is not None  # nan and inf are numbers
    return bool(first) and (
        ANY_FORMAT.number(cell) is not None
        or (sign_meaning(cell) or ("", ""))[1] == "thousands"
        or stamp(cell) is not None
        or with_unit(cell) is not None
    )


def _table(lines: Sequence[str], separator: str | None) -> _Table | None:
    """Return the table that a separator gives; None without rows."""
    sample = list(rows(lines, separator, strict=False))
    if not sample:
        return None
    trimmed = [_trimmed(cells) for _, cells in sample]
    kinds = [[is_value(cell) for cell in cells] for cells in trimmed]
    # The rows of the table end the sample: text above it may be long.
    ending = [i for i in range(len(kinds) // 2, len(kinds)) if any(kinds[i])]
    if not ending:
        return _Table(separator, sample, len(sample), len(trimmed[-1]), (), 0.0)
    # Of several messages in one file, rows have empty cells, at their end as well.
    cells_in_row = Counter(len(sample[i][1]) for i in ending).most_common(1)[0][0]
    usual = max(len(kinds[i]) for i in ending if len(sample[i][1]) == cells_in_row)
    late = range(len(kinds) // 2, len(kinds))
    numeric = tuple(i for i in range(usual) if _is_numeric(i, trimmed[late[0] :], kinds[late[0] :]))
    if not numeric:
        numeric = tuple(i for i in range(usual) if any(i < len(k) and k[i] for k in kinds))
    fits = [
        len(cells) > numeric[-1] and _fits(shorter, kind, numeric)
        for (_, cells), shorter, kind in zip(sample, trimmed, kinds, strict=True)
    ]
    if not any(fits):
        return _Table(separator, sample, len(sample), usual, (), 0.0)
    start = _first_row(fits, trimmed, _usual_texts(trimmed, numeric, usual), numeric)
    inside = [k for k, fit in zip(kinds[start:], fits[start:], strict=True) if fit]
    filled = sum(bool(c) for t, fit in zip(trimmed, fits, strict=True) if fit for c in t)
    values = sum(sum(kind) for kind in inside)
    return _Table(separator, sample, start, usual, numeric, values * values / max(filled, 1))


def _is_numeric(place: int, rows: Sequence[Sequence[str]], kinds: Sequence[Sequence[bool]]) -> bool:
    """Return whether a column has numbers in some of the rows, and seldom text."""
    filled = [
        kind[place]
        for cells, kind in zip(rows, kinds, strict=True)
        if place < len(cells) and not is_missing(cells[place])
    ]
    return len(filled) >= _SPARSE * len(rows) and 2 * sum(filled) > len(filled)


def _fits(cells: Sequence[str], kind: Sequence[bool], numeric: Sequence[int]) -> bool:
    """Return whether a row has numbers, or no text, in the columns that hold numbers."""
    found = [kind[i] for i in numeric if i < len(cells)]
    text = [i for i in numeric if i < len(cells) and not kind[i] and not is_missing(cells[i])]
    return any(found) and not text


def _usual_texts(
    trimmed: Sequence[Sequence[str]], numeric: Sequence[int], width: int
) -> list[bool]:
    """Return which rows have text in the same columns as most rows of the table."""
    columns = [i for i in range(width) if i not in numeric]
    texts = [
        tuple(bool(cells[i]) and not is_value(cells[i]) for i in columns if i < len(cells))
        for cells in trimmed
    ]
    usual = Counter(texts[len(texts) // 2 :]).most_common(1)[0][0]
    return [each == usual for each in texts]


def _continues(rows: Sequence[Sequence[str]], numeric: Sequence[int]) -> bool:
    """Return whether the first column of numbers goes on by equal steps, as times and counts do."""
    values = [ANY_FORMAT.number(cells[numeric[0]]) for cells in rows if len(cells) > numeric[0]]
    known = [value for value in values if value is not None]
    if len(known) < 3:
        return False
    step = known[1] - known[0]
    return step != 0.0 and math.isclose(known[2] - known[1], step, rel_tol=0.1)


def _first_row(
    fits: Sequence[bool],
    trimmed: Sequence[Sequence[str]],
    usual: Sequence[bool],
    numeric: Sequence[int],
) -> int:
    """Return the first row of the table: most rows after it have numbers, and no units follow."""
    for start, fit in enumerate(fits):
        ahead = fits[start : start + _AHEAD]
        if not fit or 2 * sum(ahead) < len(ahead):
            continue
        # An entry such as `Offset,0,0` is no row. A first row has further texts in some formats.
        if not usual[start] and not _continues(trimmed[start : start + 3], numeric):
            continue
        below = range(start + 1, min(start + 3, len(fits)))
        # A line with the numbers of the channels may stand above the units.
        if not any(not fits[i] and _are_units(trimmed[i], least=1.0) for i in below):
            return start
    return next(i for i, fit in enumerate(fits) if fit)


def _with_header(table: _Table, lines: Sequence[str]) -> TextLayout:
    """Return the layout with the names, units and entries above the table."""
    sample, start, width = table.sample, table.start, table.width
    first_line = sample[start][0] if start < len(sample) else len(lines) + 1
    found = TextLayout(table.separator, None, width, table.numeric, first_line)
    names, units = _header_rows(table)
    if names is None:
        comment = _commented_header(lines[: first_line - 1], table.separator)
        cells = comment if len(comment) == width else None
        top = start
        found = replace(found, cells=cells)
    else:
        texts, width = sample[names][1], max(width, len(_trimmed(sample[names][1])))
        below = [] if units is None else sample[units][1]
        cells = tuple(
            _with_unit(header_cell(text), unit)
            for text, unit in zip(_of_width(texts, width), _of_width(below, width), strict=True)
        )
        top = names if units is None else min(names, units)
        held = tuple(tuple(sample[i][1]) for i in (names, units) if i is not None)
        if not table.numeric:
            first_line = sample[names][0] + 1
        found = replace(found, cells=cells, width=width, header_lines=held, first_line=first_line)
    above = [cells for _, cells in sample[:start]]
    return replace(
        found,
        entries=_entries(above, lines[: first_line - 1]),
        skipped=top,
        signs=_signs(table),
    )


def _signs(table: _Table) -> tuple[tuple[str, Proof], ...]:
    """Return what points and commas in the numbers of the sample must be, each answer once."""
    cells = (
        cells[i]
        for _, cells in table.sample[table.start :]
        for i in table.numeric
        if i < len(cells)
    )
    return tuple(dict.fromkeys(found for cell in cells if (found := sign_meaning(cell))))


def _header_rows(table: _Table) -> tuple[int | None, int | None]:
    """Return the indices of the rows with the names and the units of the columns."""
    near = range(table.start - 1, max(table.start - 1 - _HEADER_LINES, -1), -1)
    columns = table.numeric or range(table.width)
    lines, full = {}, {}
    for i in near:
        cells = [cell for c, cell in enumerate(table.sample[i][1]) if c in columns]
        filled = sum(map(bool, cells))
        if filled < min(table.width, 2) and not _are_units(cells):
            break  # a title; names and units stand between it and the table
        lines[i] = cells
        words = table.separator is None and len(table.sample[i][1]) != table.width
        if filled >= _FILLED * len(columns) and not words:
            full[i] = cells
    units = next((i for i, cells in lines.items() if _are_units(cells)), None)
    texts = [i for i, cells in full.items() if i != units and not all(map(is_value, cells))]
    # One with units, else one with the most different texts: a line of types repeats itself.
    with_units = [
        i
        for i in texts
        if _different(full[i]) == len(full[i])
        and any(header_unit(header_cell(text).unit) for text in full[i])
    ]
    names = next(iter(with_units), max(texts, key=lambda i: _different(full[i]), default=None))
    if names is None or (units is not None and abs(units - names) > _HEADER_LINES // 2):
        return (names if names is not None or units not in full else units), None
    return names, units


def _different(cells: Sequence[str]) -> int:
    """Return the number of different texts."""
    return len({cell for cell in cells if cell and not is_value(cell)})


def _are_units(cells: Sequence[str], *, least: float = 1 / 3) -> bool:
    """Return whether a share `least` of the texts are known units, and the others are short."""
    found = [_bare_unit(cell) for cell in cells if cell]
    if any(ANY_FORMAT.number(unit) not in (None, 1.0) for unit in found):
        return False
    known = [unit for unit in found if header_unit(unit) not in (None, "1")]
    return (
        bool(known) and len(known) >= least * len(found) and max(map(len, found)) <= _LONGEST_UNIT
    )


def _bare_unit(cell: str) -> str:
    return cell.strip("[](){}<> ")


def _with_unit(cell: HeaderCell, below: str) -> HeaderCell:
    unit = _bare_unit(below)
    if not unit or ANY_FORMAT.number(unit) is not None:
        return cell
    return replace(cell, unit=unit) if header_unit(unit) or not cell.unit else cell


def _commented_header(lines: Sequence[str], separator: str | None) -> tuple[HeaderCell, ...]:
    """Return the cells of the last comment before the first row, as numpy.savetxt writes them."""
    comments = [line.strip() for line in lines if line.lstrip().startswith(_COMMENTS)]
    if not comments:
        return ()
    found = list(rows([comments[-1].lstrip("#% ")], separator, strict=False))
    return tuple(header_cell(cell) for cell in _trimmed(found[0][1])) if found else ()


def _entries(above: Sequence[Sequence[str]], lines: Sequence[str]) -> tuple[tuple[str, str], ...]:
    """Return names and values above a table: beside each other, or one below the other."""
    found = []
    for cells in above:
        filled = [cell for cell in cells if cell]
        found += list(itertools.pairwise(filled))
    for upper, lower in itertools.pairwise(above):
        found += [(a, b) for a, b in zip(upper, lower, strict=False) if a and b]
    for line in lines:
        text = line.strip().lstrip("#%/!* ")
        for sign in (":", "="):
            name, _, value = text.partition(sign)
            if value.strip():
                found.append((name.strip(), value.strip()))
    return tuple((name, value) for name, value in found if not is_value(name))


def _trimmed(cells: list[str]) -> list[str]:
    """Return the cells without empty ones at the end."""
    end = len(cells)
    while end and not cells[end - 1]:
        end -= 1
    return cells[:end]


def _of_width(cells: Sequence[str], width: int) -> list[str]:
    """Return cells of a row, with empty ones at the end if there are too few."""
    return [*cells[:width], *[""] * (width - len(cells))]


def _units_joined(cells: list[str]) -> list[str]:
    """Return words of a line with a unit in brackets joined to the word before it."""
    if not any(cell[0] in "[(" for cell in cells):
        return cells
    joined: list[str] = []
    for cell in cells:
        if joined and cell[0] in "[(" and cell[-1] in "])" and known_unit(cell[1:-1]) is not None:
            joined[-1] += f" {cell}"
        else:
            joined.append(cell)
    return joined
