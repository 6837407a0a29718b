"""Read the columns that a SIGNALS.yaml names from CSV and text files."""

from __future__ import annotations

import codecs
import csv
import difflib
import itertools
import os
from array import array
from collections.abc import Iterator
from datetime import datetime
from pathlib import Path
from typing import NamedTuple, TextIO

import numpy as np
from numpy.typing import NDArray

from ..errors import LogError
from .signals_yaml import Column, RowRange, SignalsFile
from .text_layout import MISSING, Row, TextLayout, date, number, rows, text_layout

_ENCODING_BYTES = 1 << 16
"""Bytes at the beginning of a file that decide its encoding: header and first rows."""


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
    become NaN. Decimal commas are accepted if they do not separate columns. Dates and times of day
    (ISO) in a column of role time become seconds after the first.

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
            lines = (row for row in rows(file, layout.separator) if row[0] >= layout.first_line)
            values, notes = _read_rows(path, signals, layout, places, lines)
    except (OSError, csv.Error) as error:
        raise LogError(f"{path}: cannot be read: {error}") from None
    for infinite in values:
        infinite[np.isinf(infinite)] = np.nan
    cells = layout.cells
    return TextColumns(
        values,
        ["" if cells is None else cells[place].unit for place in places],
        (*_notes(layout), *notes),
    )


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
        raise LogError(f"{where}: the file has no header; give the column's number")
    found = [i for i, cell in enumerate(layout.cells) if cell.text == column.column]
    found = found or [i for i, cell in enumerate(layout.cells) if cell.name == column.column]
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
    close = difflib.get_close_matches(column.column, texts, n=3) or texts[:20]
    raise LogError(
        f"{where}: expected once in the header, found nowhere; there is {', '.join(close)}"
    )


def _read_rows(
    path: Path,
    signals: SignalsFile,
    layout: TextLayout,
    places: list[int],
    lines: Iterator[Row],
) -> tuple[list[NDArray[np.float64]], list[str]]:
    """Return the columns, each (n,), and a note if the last line is not complete."""
    cells_of = [
        (column, place, array("d")) for column, place in zip(signals.columns, places, strict=True)
    ]
    parser = _CellParser(path)
    first, end = signals.rows.first, signals.rows.end
    count = 0
    notes = []
    for line, cells in itertools.islice(lines, end):
        if len(cells) < layout.width and next(lines, None) is None and _last_line_is_cut(path):
            notes.append(f"line {line}, the last one, is not complete; it is left out")
            break
        if count >= first:
            if len(cells) != layout.width:
                _check_width(f"{path}: line {line}", cells, layout)
            for column, place, values in cells_of:
                values.append(parser.number(line, column, cells[place]))
        count += 1
    check_length(path, signals.rows, count)
    return [np.array(values, np.float64) for _, _, values in cells_of], notes


def _last_line_is_cut(path: Path) -> bool:
    """Return whether a file does not end with a line break, as after a logger was stopped."""
    with path.open("rb") as file:
        file.seek(-min(2, path.stat().st_size), os.SEEK_END)
        return not set(file.read()) & set(b"\r\n")


def _check_width(where: str, cells: list[str], layout: TextLayout) -> None:
    if len(cells) == layout.width + 1 and not cells[-1]:
        return
    remedy = ""
    if layout.separator == "," and len(cells) > layout.width:
        remedy = "; if commas are decimal commas, separate the columns by semicolons or tabs"
    raise LogError(
        f"{where}: expected {layout.width} cells, as in the first row, found {len(cells)}{remedy}"
    )


class _CellParser:
    """Convert cells to numbers; raise LogError for a file with decimal points and commas."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._point = self._comma = False
        self._first_date: dict[str, datetime] = {}

    def number(self, line: int, column: Column, cell: str) -> float:
        """Return a cell's number; NaN for a cell without a value."""
        try:
            value = float(cell)
        except ValueError:
            return self._other(line, column, cell)
        if "_" in cell:
            return self._other(line, column, cell)
        if not self._point and "." in cell:
            self._set(line, column, cell, point=True)
        return value

    def _other(self, line: int, column: Column, cell: str) -> float:
        if cell.lower() in MISSING:
            return float("nan")
        value = number(cell)
        if value is not None:
            self._set(line, column, cell, comma=True)
            return value
        when = date(cell) if column.role == "time" else None
        if when is None:
            remedy = ""
            if "," in cell and "." in cell:
                remedy = "; remove the separators of thousands"
            raise LogError(
                f"{self._path}: line {line}, {column.label}: expected a number, found "
                f"{cell[:40]!r}{remedy}"
            )
        if column.unit != "s":
            raise LogError(
                f"{self._path}: {column.label}: dates and times of day are converted to s; "
                f"expected unit: s, found {column.unit}"
            )
        first = self._first_date.setdefault(column.name, when)
        return (when - first).total_seconds()

    def _set(
        self, line: int, column: Column, cell: str, *, point: bool = False, comma: bool = False
    ) -> None:
        self._point |= point
        self._comma |= comma
        if self._point and self._comma:
            raise LogError(
                f"{self._path}: line {line}, {column.label}: expected decimal points or decimal "
                f"commas in the whole file, found both: {cell!r} after other numbers with a "
                f"{'comma' if point else 'point'}"
            )


def _notes(layout: TextLayout) -> tuple[str, ...]:
    if not layout.skipped:
        return ()
    lines = "1 line" if layout.skipped == 1 else f"{layout.skipped} lines"
    return (f"{lines} of text above the header skipped",)
