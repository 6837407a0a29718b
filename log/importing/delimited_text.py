"""Read the columns that a SIGNALS.yaml names from CSV and text files."""

from __future__ import annotations

import codecs
import csv
import difflib
import itertools
import os
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple, TextIO

import numpy as np
from numpy.typing import NDArray

from ..errors import LogError
from .column_reader import ColumnReader, check_signs
from .header_units import header_cell
from .number_cells import is_missing, strange_letters
from .signals_yaml import Column, RowRange, SignalsFile
from .text_layout import Row, TextLayout, is_value, rows, text_layout

_ENCODING_BYTES = 1 << 16
"""Bytes at the beginning of a file that decide its encoding: header and first rows."""

_DECIMAL_COMMAS = " if commas are decimal commas, separate the columns by semicolons or tabs"
_LONGEST_TEXT_LINES = 40
"""Most lines of text between two segments of a file, or below its rows."""


class TextColumns(NamedTuple):
    """Columns of a text file, each (n,), NaN where a value is missing.

    units: of each column according to the header, "" if it says none. notes: what was skipped.
    """

    values: list[NDArray[np.float64]]
    units: list[str]
    notes: tuple[str, ...] = ()


def open_text(path: Path) -> TextIO:
    """Open a text file in UTF-8, in UTF-16 (as spreadsheets save it), or in Windows-1252."""
    with path.open("rb") as file:
        beginning = file.read(_ENCODING_BYTES)
    encoding = "utf-8-sig"
    if beginning.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        encoding = "utf-16"
    else:
        try:
            codecs.getincrementaldecoder("utf-8")().decode(beginning)
        except UnicodeDecodeError:
            encoding = "cp1252"
    return path.open(encoding=encoding, errors="replace", newline="")


def read_delimited(path: Path, signals: SignalsFile, *, whitespace: bool) -> TextColumns:
    """Return columns of a text file; `whitespace`: whether white space is tried first as separator.

    A name in `signals` may omit the unit in the header. Cells without a value, and infinite ones,
    become NaN. Decimal commas are accepted if they do not separate columns, separators of thousands
    if `signals` states them. Dates and times of day in a column of role time become seconds after
    the first.

    Raises:
        LogError: a cell or row does not fit; names its line in the file.
    """
    for column in signals.columns:
        if column.index is not None:
            raise LogError(f"{path}: {column.label}: index is for variables of NPZ and MAT files")
    try:
        with open_text(path) as file:
            layout = text_layout(file, whitespace=whitespace)
            if layout is None:
                raise LogError(f"{path}: expected rows of numbers, found none")
            file.seek(0)
            places = [column_place(path, column, layout) for column in signals.columns]
            lines = rows(file, layout.separator, first=layout.first_line)
            found, notes = _read_rows(path, signals, layout, places, lines)
    except (OSError, csv.Error) as error:
        raise LogError(f"{path}: cannot be read: {error}") from None
    for infinite in found.values:
        infinite[np.isinf(infinite)] = np.nan
    cells = layout.cells
    units = [
        (cells[place].unit if cells is not None else "") or unit
        for place, unit in zip(places, found.units, strict=True)
    ]
    return TextColumns(found.values, units, (*_notes(layout), *notes))


def check_length(path: Path, rows: RowRange, count: int) -> None:
    """Raise LogError if a file of `count` rows does not have the rows to import."""
    if count <= (rows.first if rows.last is None else rows.last):
        wanted = f"{rows.first} on" if rows.last is None else f"{rows.first} to {rows.last}"
        raise LogError(f"{path}: expected rows {wanted}, found {count} rows")


def column_place(path: Path, column: Column, layout: TextLayout) -> int:
    """Return the index of a column's cell in a row; raise LogError if there is no such column."""
    where = f"{path}: {column.label}"
    if isinstance(column.column, int):
        if column.column >= layout.width:
            raise LogError(f"{where}: expected a column number from 0 to {layout.width - 1}")
        return column.column
    if layout.cells is None:
        commas = f", or{_DECIMAL_COMMAS}" if layout.separator == "," else ""
        raise LogError(f"{where}: the file has no header; give the column's number{commas}")
    name = header_cell(column.column).text
    found = [i for i, cell in enumerate(layout.cells) if cell.text == name]
    found = found or [i for i, cell in enumerate(layout.cells) if cell.name == name]
    if len(found) == 1:
        return found[0]
    texts = [cell.text for cell in layout.cells if cell.text]
    if found:
        same = {layout.cells[i].text for i in found}
        remedy = (
            f" ({', '.join(sorted(same))}); give the name with its unit"
            if len(same) > 1
            else "; give the column's number"
        )
        times = "twice" if len(found) == 2 else f"{len(found)} times"
        raise LogError(f"{where}: expected once in the header, found {times}{remedy}")
    close = difflib.get_close_matches(name, texts, n=3) or texts[:20]
    strange = strange_letters("".join([name, *close]))
    raise LogError(
        f"{where}: expected once in the header, found nowhere; there is {', '.join(close)}{strange}"
    )


def _read_rows(
    path: Path,
    signals: SignalsFile,
    layout: TextLayout,
    places: list[int],
    lines: Iterator[Row],
) -> tuple[TextColumns, list[str]]:
    """Return the columns, each (n,), and notes on lines that are left out."""
    readers = [ColumnReader(path, column, signals, layout) for column in signals.columns]
    places_of = list(zip(readers, places, strict=True))
    last_place = max(layout.numeric, default=0)
    header_lines = set(layout.header_lines)
    first, end = signals.rows.first, signals.rows.end
    count, texts, notes = 0, [], []
    text_end: int | None = 0
    for line, cells in lines:
        if count == end:
            break
        if text_end is not None and line > text_end and _begins_with_text(cells, layout):
            text_end = _text_end(path, layout, line)
        if line <= (text_end or 0) or tuple(cells) in header_lines:
            texts.append(line)
            continue
        if len(cells) > layout.width and not any(cells[layout.width :]):
            pass  # a separator at the end of each line
        elif len(cells) != layout.width:
            if _is_text(cells, layout):
                texts.append(line)
                continue
            if len(cells) <= last_place and next(lines, None) is None and _last_line_is_cut(path):
                notes.append(f"line {line}, the last one, is not complete; it is left out")
                break
            cells = _fitted(f"{path}: line {line}", cells, layout, last_place)  # noqa: PLW2901
        if count >= first:
            for reader, place in places_of:
                reader.read(line, cells[place])
        count += 1
    check_length(path, signals.rows, count)
    check_signs(path, readers, layout)
    if texts:
        numbers = f"line {texts[0]}" if len(texts) == 1 else f"{len(texts)} lines"
        where = "" if len(texts) == 1 else f" (lines {texts[0]} to {texts[-1]})"
        notes.append(f"{numbers} of text between or below the rows left out{where}")
    notes += [note for reader in readers for note in reader.notes()]
    return TextColumns([reader.values() for reader in readers], [r.unit for r in readers]), notes


def _is_text(cells: list[str], layout: TextLayout) -> bool:
    """Return whether a line of another length is no row: a comment, an entry, a second header."""
    inside = [cells[i] for i in layout.numeric if i < len(cells)]
    return _begins_with_text(cells, layout) or not any(map(is_value, inside))


def _begins_with_text(cells: list[str], layout: TextLayout) -> bool:
    return 0 in layout.numeric and not (is_value(cells[0]) or is_missing(cells[0]))


def _text_end(path: Path, layout: TextLayout, line: int) -> int | None:
    """Return the last line of text that begins here: a head of a further segment, or a summary.

    None if the line is a row with a wrong cell.
    """
    with open_text(path) as file:
        ahead = list(
            itertools.islice(rows(file, layout.separator, first=line), _LONGEST_TEXT_LINES)
        )
    headers = [at for at, cells in ahead if tuple(cells) in layout.header_lines]
    below = 1 < len(ahead) < _LONGEST_TEXT_LINES
    if not headers and below and all(_begins_with_text(cells, layout) for _, cells in ahead):
        return ahead[-1][0]
    return max(headers, default=None)


def _last_line_is_cut(path: Path) -> bool:
    """Return whether a file does not end with a line break, as after a logger was stopped."""
    with path.open("rb") as file:
        file.seek(-min(2, path.stat().st_size), os.SEEK_END)
        return not set(file.read()) & set(b"\r\n")


def _fitted(where: str, cells: list[str], layout: TextLayout, last_place: int) -> list[str]:
    """Return the cells of a row in the layout's width; raise LogError if numbers lack or exceed."""
    if last_place < len(cells) < layout.width:
        return [*cells, *[""] * (layout.width - len(cells))]
    remedy = "; correct the line, or delete it if a column holds the times"
    if layout.separator == "," and len(cells) == 2 * layout.width:
        remedy = f";{_DECIMAL_COMMAS}"
    raise LogError(
        f"{where}: expected {layout.width} cells, as in the first row, found {len(cells)}{remedy}"
    )


def _notes(layout: TextLayout) -> tuple[str, ...]:
    if not layout.skipped:
        return ()
    lines = "1 line" if layout.skipped == 1 else f"{layout.skipped} lines"
    return (f"{lines} of text above the header skipped",)
