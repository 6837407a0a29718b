"""List the columns of numbers in a data file: names, units and shapes."""

from __future__ import annotations

import csv
import itertools
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..errors import LogError
from .array_variables import (
    DATES,
    MATLAB_OBJECT,
    Variable,
    list_variables,
    load_npz,
)
from .delimited_text import open_text
from .header_units import HeaderCell, header_cell
from .importer import file_format, raw_columns
from .mat_file_reader import list_mat
from .number_cells import ANY_FORMAT, NumberFormat, Proof, is_missing, with_unit
from .recording_rate import stated_rate
from .signals_yaml import Format, SignalsFile
from .text_layout import TextLayout, is_value, rows, text_layout
from .time_cells import stamp

Array = NDArray[np.float64]

_SAMPLE_ROWS = 100
_LEAST_SAMPLES = 10
_MOST_SIGNALS = 32
"""Most signals of one matrix that are listed."""


@dataclass(frozen=True)
class FileColumn:
    """A column of numbers, with `column` and `index` as in SIGNALS.yaml.

    label: its name without unit; label and unit are "" if the file does not state them. dates:
    whether the cells are dates or times of day.
    """

    column: int | str
    label: str
    unit: str = ""
    index: int | None = None
    dates: bool = False


@dataclass(frozen=True)
class FileColumns:
    """Columns of numbers of one length; what else the file holds; where samples of a matrix are.

    rate: name and value in Hz of an entry that says the rate; None without one. number_format:
    signs of the numbers in a text file. two_meanings: a number of it that this leaves open.
    """

    format: Format
    columns: tuple[FileColumn, ...]
    others: tuple[str, ...] = ()
    samples: str = "rows"
    rate: tuple[str, float] | None = None
    number_format: NumberFormat = ANY_FORMAT
    two_meanings: str = ""


def list_columns(path: Path) -> FileColumns:
    """Return the columns of a data file; raise LogError if it cannot be read."""
    kind = file_format(path)
    if kind in ("csv", "text"):
        return _text_columns(path, kind)
    variables = list_variables(load_npz(path)) if kind == "npz" else list_mat(path)
    return _array_columns(kind, variables)


def read_columns(path: Path, found: FileColumns) -> tuple[list[Array], str]:
    """Return the values of the columns, each (N,), in the units of the file, dates in s.

    A column whose values cannot be read is empty; the text says why, "" if all can be read.
    """
    try:
        return _read_group(path, found, range(len(found.columns))), ""
    except LogError as error:
        reason = str(error)
    each = []
    for i in range(len(found.columns)):
        try:
            each += _read_group(path, found, [i])
        except LogError:
            each.append(np.empty(0))
    return each, reason


def _read_group(path: Path, found: FileColumns, group: Sequence[int]) -> list[Array]:
    entries = [
        {
            "column": found.columns[i].column,
            "index": found.columns[i].index,
            "name": f"c{i}",
            "unit": "s",
            "role": "time" if found.columns[i].dates else "other",
        }
        for i in group
    ]
    signals = SignalsFile.model_validate(
        {
            "levid": "signals",
            "rate_hz": 1,
            "format": found.format,
            "samples": found.samples,
            "columns": entries,
            "decimal": found.number_format.decimal,
            "thousands": found.number_format.thousands,
        }
    )
    return raw_columns(path, signals).values


def _text_columns(path: Path, kind: Format) -> FileColumns:
    try:
        with open_text(path) as file:
            layout = text_layout(file, whitespace=kind == "text")
            if layout is None:
                return FileColumns(kind, ())
            file.seek(0)
            lines = rows(file, layout.separator, first=layout.first_line)
            sample = [cells for _, cells in itertools.islice(lines, _SAMPLE_ROWS)]
    except (OSError, csv.Error) as error:
        raise LogError(f"{path}: cannot be read: {error}") from None
    columns, others = [], []
    texts = [cell.text for cell in layout.cells or ()]
    for place in range(layout.width):
        cells = [row[place] for row in sample if place < len(row)]
        text = texts[place] if place < len(texts) else ""
        # A name that is empty or occurs twice cannot be given.
        reference: int | str = text if text and texts.count(text) == 1 else place
        values = [cell for cell in cells if not is_missing(cell) and is_value(cell)]
        if not values or 2 * len(values) < sum(not is_missing(cell) for cell in cells):
            others.append(f"column {place} {text!r}: no numbers")
            continue
        if place not in layout.numeric:
            others.append(f"column {place} {text!r}: numbers in few rows")
            continue
        cell = layout.cells[place] if layout.cells else HeaderCell("", "")
        if ANY_FORMAT.number(values[0]) is None and stamp(values[0]) is not None:
            columns.append(FileColumn(reference, cell.name or "time", "s", dates=True))
            continue
        parts = None if ANY_FORMAT.number(values[0]) is not None else with_unit(values[0])
        columns.append(FileColumn(reference, cell.name, cell.unit or (parts[2] if parts else "")))
    number_format, open_number = _number_format(layout, sample)
    return FileColumns(
        kind,
        tuple(columns),
        tuple(others),
        rate=stated_rate(layout.entries),
        number_format=number_format,
        two_meanings=open_number,
    )


def _number_format(layout: TextLayout, sample: Sequence[Sequence[str]]) -> tuple[NumberFormat, str]:
    """Return the signs of the numbers that a SIGNALS.yaml must state, and a number left open."""
    signs: list[tuple[str, Proof]] = list(layout.signs)
    decimal = [sign for sign, proof in signs if proof == "decimal"]
    thousands = [sign for sign, proof in signs if proof == "thousands"]
    if thousands and thousands[0] not in decimal:
        return NumberFormat(None, "." if thousands[0] == "." else ","), ""
    for sign, proof in signs:
        if proof == "either" and sign not in decimal:
            cells = (row[i] for row in sample for i in layout.numeric if i < len(row))
            shown = next((cell for cell in cells if sign in cell), "")
            if decimal:
                return NumberFormat(None, "." if sign == "." else ","), shown
            return NumberFormat("." if sign == "." else ",", None), shown
    return ANY_FORMAT, ""


def _array_columns(kind: Format, variables: Sequence[Variable]) -> FileColumns:
    lengths = Counter(max(v.shape) for v in variables if v.shape and max(v.shape) >= _LEAST_SAMPLES)
    length = max(lengths, key=lambda n: (lengths[n], n), default=0)
    matrices = [v for v in variables if len(v.shape) == 2 and min(v.shape) > 1]
    samples = "columns" if [v for v in matrices if v.shape[1] == length] else "rows"
    labels = {v.path.rpartition(".")[0]: v.value for v in variables if _is_label(v)}
    columns: list[FileColumn] = []
    others: list[str] = []
    for variable in variables:
        shape = variable.shape
        dates = variable.content in DATES and max(shape, default=0) == length
        if dates and length and int(np.prod(shape)) == length:
            columns.append(FileColumn(variable.path, variable.path, "s", dates=True))
            continue
        if variable.content is None and length and len(shape) and max(shape) == length:
            label = labels.get(variable.path.rpartition(".")[0])
            last = variable.path.rpartition(".")[2]
            cell = header_cell(str(label) if last == "values" and label else last)
            if int(np.prod(shape)) == length:
                columns.append(FileColumn(variable.path, cell.name, cell.unit))
                continue
            signals = shape[1] if shape[0] == length else shape[0]
            fits = len(shape) == 2 and (shape[0] == length) == (samples == "rows")
            if fits and signals <= _MOST_SIGNALS:
                columns += _matrix_columns(variable, signals, cell.name, only=len(matrices) == 1)
                continue
        others.append(_described(variable))
    return FileColumns(kind, tuple(columns), tuple(others), samples, _rate(variables))


def _matrix_columns(
    variable: Variable, signals: int, label: str, *, only: bool
) -> list[FileColumn]:
    """Return the signals of a matrix: by number if it is the file's only one, else by index."""
    if only and "." not in variable.path:
        return [FileColumn(number, "") for number in range(signals)]
    return [FileColumn(variable.path, f"{label}_{n}", index=n) for n in range(signals)]


def _is_label(variable: Variable) -> bool:
    return variable.path.endswith(".label") and bool(variable.value)


def _described(variable: Variable) -> str:
    if variable.content == MATLAB_OBJECT:
        return MATLAB_OBJECT  # its name is not known
    if variable.content is not None:
        text = f" {variable.value!r}" if variable.value else ""
        return f"{variable.path}: {variable.content}{text}"
    if isinstance(variable.value, float):
        return f"{variable.path} = {variable.value:g}"
    return f"{variable.path}: {' x '.join(map(str, variable.shape))}"


def _rate(variables: Sequence[Variable]) -> tuple[str, float] | None:
    scalars = [(v.path, v.value) for v in variables if isinstance(v.value, float)]
    return stated_rate(scalars)
