"""Read the columns that a SIGNALS.yaml names from CSV, text, NPZ and MAT files."""

from __future__ import annotations

import csv
import difflib
import itertools
import math
from array import array
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, TextIO

import numpy as np
import scipy.io
from numpy.typing import NDArray

from .errors import LogError
from .signals_yaml import Column, RowRange, SignalsFile

Columns = list[NDArray[np.float64]]


def read_delimited(path: Path, signals: SignalsFile, *, whitespace: bool) -> Columns:
    """Return the columns of a text file, each (n,), finite; separated by commas or white space.

    CSV may use semicolons or tabs instead. A first row that is not all numbers is a header. A comma
    at the end of each row adds no column. Text lines that start with # or % are comments.

    Raises:
        LogError: a cell or row does not fit; names its line in the file.
    """
    for column in signals.columns:
        if column.index is not None:
            raise LogError(f"{path}: {column.label}: index is for variables of NPZ and MAT files")
    try:
        with path.open(encoding="utf-8-sig", errors="replace", newline="") as file:
            lines = _text_lines(file) if whitespace else _csv_lines(file)
            return _read_lines(path, signals, lines)
    except (OSError, csv.Error) as error:
        raise LogError(f"{path}: cannot be read: {error}") from None


def read_variables(path: Path, signals: SignalsFile, variables: Mapping[str, Any]) -> Columns:
    """Return columns from named arrays, each (n,), finite.

    Raises:
        LogError: a variable is missing, of the wrong shape or type, too short or not finite.
    """
    columns = []
    for column in signals.columns:
        where = f"{path}: {column.label}"
        found = np.asarray(_variable(where, column, variables))
        if found.dtype.kind not in "fiub":
            raise LogError(f"{where}: expected real numbers, found {found.dtype}")
        columns.append(_vector(where, found.astype(np.float64), column.index, signals.samples))
    for column, values in zip(signals.columns, columns, strict=True):
        if values.size != columns[0].size:
            raise LogError(
                f"{path}: {column.label}: expected {columns[0].size} samples, as "
                f"{signals.columns[0].label} has, found {values.size}"
            )
    _check_length(path, signals.rows, columns[0].size)
    begin, end = signals.rows.first, signals.rows.end
    columns = [values[begin:end] for values in columns]
    for column, values in zip(signals.columns, columns, strict=True):
        bad = np.flatnonzero(~np.isfinite(values))
        if bad.size:
            raise LogError(
                f"{path}: {column.label}: row {begin + bad[0]}: expected a finite number, "
                f"found {values[bad[0]]}"
            )
    return columns


def load_npz(path: Path) -> dict[str, NDArray[Any]]:
    """Return the arrays of an NPZ file by name; raise LogError if it is not an NPZ file.

    Arrays of Python objects come without their content: unpickling would run code from the file.
    """
    try:
        loaded = np.load(path, allow_pickle=False)
        if isinstance(loaded, np.ndarray):
            raise LogError(f"{path}: expected an NPZ file of named arrays, found one array (NPY)")
        found: dict[str, NDArray[Any]] = {}
        with loaded:
            for name in loaded.files:
                try:
                    found[name] = loaded[name]
                except ValueError as error:
                    if "allow_pickle" not in str(error):
                        raise
                    found[name] = np.array([None], object)
        return found
    except LogError:
        raise
    except Exception as error:  # noqa: BLE001 - zipfile, zlib and numpy raise different errors
        raise LogError(f"{path}: not a usable NPZ file: {error}") from None


def load_mat(path: Path) -> dict[str, Any]:
    """Return the variables of a MAT file by name, structs as dicts; raise LogError if damaged.

    Some damaged files crash scipy's reader and its process, which is a child: see mat_file.
    """
    try:
        loaded = scipy.io.loadmat(path, simplify_cells=True)
    except NotImplementedError:
        raise LogError(
            f"{path}: expected a MAT file up to version 7, found 7.3 (HDF5); "
            "in MATLAB, load it and save it again with save(..., '-v7')"
        ) from None
    except Exception as error:  # noqa: BLE001 - damage makes scipy raise almost anything
        raise LogError(f"{path}: not a usable MAT file: {error}") from None
    return {name: value for name, value in loaded.items() if not name.startswith("__")}


def _csv_lines(file: TextIO) -> Iterator[tuple[int, list[str]]]:
    """Yield line number and cells of each row that is not blank."""
    first = file.readline()
    file.seek(0)
    # With semicolons or tabs, a comma is a decimal comma, and the number is rejected.
    separators = [s for s in (";", "\t", ",") if s in first]
    separator = separators[0] if separators else ","
    reader = csv.reader(file, delimiter=separator, skipinitialspace=True, strict=True)
    for cells in reader:
        if any(cell.strip() for cell in cells):
            yield reader.line_num, cells


def _text_lines(file: TextIO) -> Iterator[tuple[int, list[str]]]:
    """Yield line number and cells of each row that is neither blank nor a comment."""
    for number, line in enumerate(file, 1):
        cells = line.split()
        if cells and cells[0][0] not in "#%":
            yield number, cells


def _read_lines(
    path: Path, signals: SignalsFile, lines: Iterator[tuple[int, list[str]]]
) -> Columns:
    first_line = next(lines, None)
    if first_line is None:
        raise LogError(f"{path}: expected rows of numbers, found none")
    head = [cell.strip() for cell in first_line[1]]
    if head[-1] == "":
        head.pop()
    is_header = any(cell and not _is_number(cell) for cell in head)
    places = [_place(path, column, head, is_header) for column in signals.columns]
    columns = [array("d") for _ in places]
    first, end = signals.rows.first, signals.rows.end
    count = 0
    for number, cells in lines if is_header else itertools.chain([first_line], lines):
        if end is not None and count == end:
            break
        if count >= first:
            _check_width(f"{path}: line {number}", cells, len(head))
            for column, values, place in zip(signals.columns, columns, places, strict=True):
                values.append(_number(f"{path}: line {number}", column, cells[place]))
        count += 1
    _check_length(path, signals.rows, count)
    return [np.frombuffer(values, np.float64) for values in columns]


def _place(path: Path, column: Column, head: list[str], is_header: bool) -> int:
    """Return the index of the column's cell in a row."""
    if isinstance(column.column, int):
        if column.column >= len(head):
            raise LogError(
                f"{path}: {column.label}: expected a column number from 0 to {len(head) - 1}"
            )
        return column.column
    if not is_header:
        raise LogError(f"{path}: {column.label}: the file has no header; give the column's number")
    if head.count(column.column) != 1:
        times = "twice" if column.column in head else "nowhere"
        raise LogError(
            f"{path}: {column.label}: expected once in the header, found {times}"
            f"{_close(column.column, [name for name in head if name])}"
        )
    return head.index(column.column)


def _check_width(where: str, cells: list[str], width: int) -> None:
    if len(cells) == width + 1 and not cells[-1].strip():
        return
    if len(cells) != width:
        raise LogError(f"{where}: expected {width} cells, as in the first row, found {len(cells)}")


def _number(where: str, column: Column, cell: str) -> float:
    try:
        value = float(cell)
    except ValueError:
        found = repr(cell[:40]) if cell.strip() else "an empty cell"
        raise LogError(f"{where}, {column.label}: expected a number, found {found}") from None
    if not math.isfinite(value):
        raise LogError(f"{where}, {column.label}: expected a finite number, found {cell.strip()}")
    return value


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return True


def _check_length(path: Path, rows: RowRange, count: int) -> None:
    if count <= (rows.first if rows.last is None else rows.last):
        wanted = f"{rows.first} on" if rows.last is None else f"{rows.first} to {rows.last}"
        raise LogError(f"{path}: expected rows {wanted}, found {count} rows")


def _variable(where: str, column: Column, variables: Mapping[str, Any]) -> object:
    """Return a variable, or a field of a struct: `name.field`."""
    if isinstance(column.column, int):
        raise LogError(f"{where}: expected a variable's name; there is {', '.join(variables)}")
    if column.column in variables:
        return variables[column.column]
    found: object = variables
    for part in column.column.split("."):
        if not isinstance(found, Mapping) or part not in found:
            known = found if isinstance(found, Mapping) else variables
            raise LogError(f"{where}: no such variable{_close(part, list(known))}")
        found = found[part]
    return found


def _vector(
    where: str, values: NDArray[np.float64], index: int | None, samples: str
) -> NDArray[np.float64]:
    """Return one signal, (n,), from a vector, or from a matrix by index."""
    if index is None and values.ndim and values.size == max(values.shape):
        return values.ravel()
    if values.ndim != 2 or index is None:
        expected = "a vector" if index is not None else "a vector, or an index into a matrix"
        raise LogError(f"{where}: expected {expected}, found shape {values.shape}")
    by_signal: NDArray[np.float64] = values.T if samples == "rows" else values
    if index >= by_signal.shape[0]:
        raise LogError(
            f"{where}: expected index 0 to {by_signal.shape[0] - 1} in shape {values.shape} with "
            f"samples along {samples}, found {index}"
        )
    signal: NDArray[np.float64] = by_signal[index]
    return signal


def _close(name: str, known: list[str]) -> str:
    close = difflib.get_close_matches(name, known, n=3) or known[:20]
    return f"; there is {', '.join(close)}" if close else ""
