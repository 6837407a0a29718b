"""Read the columns that a SIGNALS.yaml names from the arrays of NPZ, NPY and MAT files."""

from __future__ import annotations

import difflib
import re
import zipfile
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import scipy.io
import scipy.sparse
from numpy.typing import NDArray

from ..errors import LogError
from ..unpacked_size import most_unpacked_bytes, too_much
from .delimited_text import check_length
from .signals_yaml import Column, SignalsFile

Columns = list[NDArray[np.float64]]

ONLY = "array"
"""Name of the array of an NPY file."""
MATLAB_OBJECT = (
    "a MATLAB object (a timeseries, table or timetable), which only MATLAB reads; in MATLAB, save "
    "its arrays, such as t = x.Time; y = x.Data; save('data.mat', 't', 'y', '-v7')"
)
"""Content of a variable that scipy does not read, with a remedy."""
_KINDS = {
    "c": "complex numbers",
    "O": "a cell array or objects",
    "M": "dates",
    "m": "durations",
    "V": "a structured array",
}
"""Contents of arrays by the kind of their type."""
DATES = frozenset({_KINDS["M"], _KINDS["m"]})
"""Contents that are read as times."""
_MOST_FULL_VALUES = 50_000_000
"""Most values of a sparse matrix that is filled with its zeros."""
_LONGEST_TEXT = 100
_MOST_DEPTH = 8
"""Most levels of structs that are listed."""
_ELEMENT = re.compile(r"(?P<name>.*)\((?P<index>[1-9]\d*)\)")


@dataclass(frozen=True)
class Variable:
    """A variable, or a field of a struct: its path as `column` names it, and its shape.

    content: None for real numbers, else what the variable holds instead. value: the number of a
    scalar or a short text, None for others.
    """

    path: str
    shape: tuple[int, ...] = ()
    content: str | None = None
    value: float | str | None = None


def read_variables(path: Path, signals: SignalsFile, variables: Mapping[str, Any]) -> Columns:
    """Return columns from named arrays, each (n,), NaN where a value is not finite.

    Raises:
        LogError: a variable is missing, of the wrong shape or type, or too short.
    """
    columns = []
    for column in signals.columns:
        where = f"{path}: {column.label}"
        value, index = _chosen(where, column, variables)
        value = _as_array(value)
        if column.role == "time" and isinstance(value, np.ndarray) and value.dtype.kind in "mM":
            value = _seconds(where, column, value)
        content = _content(value)
        if content is not None:
            raise LogError(
                f"{where}: expected real numbers, found {content}{_remedy(value, column)}"
            )
        values = np.asarray(value).astype(np.float64)
        columns.append(_vector(where, values, index, signals.samples))
    for column, values in zip(signals.columns, columns, strict=True):
        if values.size != columns[0].size:
            raise LogError(
                f"{path}: {column.label}: expected {columns[0].size} samples, as "
                f"{signals.columns[0].label} has, found {values.size}"
            )
    check_length(path, signals.rows, columns[0].size)
    begin, end = signals.rows.first, signals.rows.end
    chosen = [v[begin:end] for v in columns]
    for values in chosen:  # in place: they are copies already
        values[~np.isfinite(values)] = np.nan
    return chosen


def list_variables(variables: Mapping[str, Any]) -> list[Variable]:
    """Return all variables and fields of structs, in the order of the file."""
    return [found for name, value in variables.items() for found in _listed(name, value)]


def load_npz(path: Path) -> dict[str, NDArray[Any]]:
    """Return the arrays of an NPZ or NPY file by name; raise LogError for another file.

    Arrays of Python objects come without their content: unpickling would run code from the file.
    """
    try:
        loaded = np.load(path, allow_pickle=False)
        if isinstance(loaded, np.ndarray):
            return {ONLY: loaded}
        found: dict[str, NDArray[Any]] = {}
        with loaded:
            _check_unpacked(path, loaded.zip.infolist())
            for name in loaded.files:
                try:
                    found[name] = loaded[name]
                except ValueError as error:
                    if "allow_pickle" not in str(error):
                        raise
                    found[name] = np.array([None], object)
        return found
    except Exception as error:  # noqa: BLE001 - zipfile, zlib and numpy raise different errors
        raise LogError(f"{path}: not a usable NPZ file: {error}") from None


def _check_unpacked(path: Path, members: Iterable[zipfile.ZipInfo]) -> None:
    # zipfile reads no more of a member than the size that the archive states.
    on_disk, unpacked = path.stat().st_size, sum(member.file_size for member in members)
    if unpacked > most_unpacked_bytes(on_disk):
        raise LogError(
            f"{too_much(on_disk, unpacked)}; if it is right, save it without compression"
        )


def load_mat(path: Path) -> dict[str, Any]:
    """Return the variables of a MAT file by name, structs as dicts; raise LogError if damaged.

    Some damaged files crash scipy's reader and its process, which is a child: see mat_file_reader.
    """
    try:
        loaded = scipy.io.loadmat(path, simplify_cells=True)
    except NotImplementedError:
        raise LogError(
            f"{path}: expected a MAT file up to version 7, found 7.3 (HDF5); "
            "in MATLAB, load it and save it again with save(..., '-v7')"
        ) from None
    except MemoryError:
        raise  # of the child process, which has a limit
    except Exception as error:  # noqa: BLE001 - damage makes scipy raise almost anything
        remedy = "; in Octave, save it with save('-v7', ...)" if _is_of_octave(path) else ""
        raise LogError(f"{path}: not a usable MAT file: {error}{remedy}") from None
    return {name: value for name, value in loaded.items() if not name.startswith("__")}


def _is_of_octave(path: Path) -> bool:
    with path.open("rb") as file:
        return file.read(20).startswith(b"# Created by Octave")


def _listed(path: str, value: object, depth: int = 0) -> Iterator[Variable]:
    value = _as_array(value)
    if depth < _MOST_DEPTH and isinstance(value, np.ndarray) and value.dtype.names:
        value = {name: value[name] for name in value.dtype.names}
    if depth < _MOST_DEPTH and isinstance(value, Mapping):
        for name, field in value.items():
            yield from _listed(f"{path}.{name}", field, depth + 1)
    elif depth < _MOST_DEPTH and _is_struct_array(value):
        for number, element in enumerate(value, 1):  # type: ignore[var-annotated, arg-type]
            yield from _listed(f"{path}({number})", element, depth + 1)
    elif (content := _content(value)) is not None:
        short = isinstance(value, str) and len(value) <= _LONGEST_TEXT
        shape = np.asarray(value).shape if content in DATES else ()
        yield Variable(path, shape, content, str(value) if short else None)
    else:
        array = np.asarray(value)
        yield Variable(path, array.shape, value=float(array.item()) if array.size == 1 else None)


def _as_array(value: object) -> object:
    """Return a sparse matrix as a full one, and a cell array of numbers as numbers."""
    if scipy.sparse.issparse(value):
        shape = value.shape  # type: ignore[attr-defined]
        return value.toarray() if np.prod(shape) <= _MOST_FULL_VALUES else value  # type: ignore[attr-defined]
    cells = isinstance(value, np.ndarray) and value.dtype.kind == "O"
    if cells and value.size and all(isinstance(v, (int, float)) for v in value.flat):  # type: ignore[attr-defined]
        return value.astype(np.float64)  # type: ignore[attr-defined]
    return value


def _seconds(where: str, column: Column, value: NDArray[Any]) -> NDArray[np.float64]:
    """Return dates or durations of numpy as seconds after the first."""
    if column.unit != "s":
        raise LogError(
            f"{where}: dates and durations are converted to s; expected unit: s, found "
            f"{column.unit}"
        )
    flat = value.ravel()
    known = flat[~np.isnat(flat)]
    return np.asarray((flat - known[0]) / np.timedelta64(1, "ns") * 1e-9 if len(known) else flat)


def _remedy(value: object, column: Column) -> str:
    """Return what to do with a variable that holds no real numbers."""
    name = column.column
    kind = np.asarray(value).dtype.kind
    if kind == "c":
        return f"; save its parts, such as real({name}), imag({name}) or abs({name}), as variables"
    if kind in "mM":
        return "; dates and durations are read with role time"
    if kind == "V":
        fields = ", ".join(f"{name}.{field}" for field in np.asarray(value).dtype.names or ())
        return f"; give one of its fields: {fields}"
    if kind == "O" and not isinstance(value, (Mapping, scipy.io.matlab.MatlabOpaque)):
        return (
            f"; of a cell array, save the numbers: cell2mat({name}) in MATLAB; of Python objects, "
            "save arrays of numbers"
        )
    return ""


def _is_struct_array(value: object) -> bool:
    return isinstance(value, list) and all(isinstance(element, Mapping) for element in value)


def _content(value: object) -> str | None:
    """Return in words what a variable holds that is not real numbers; None for real numbers."""
    if isinstance(value, Mapping):
        return f"a struct with the fields {', '.join(value)}"
    if _is_struct_array(value):
        return f"{len(value)} structs"  # type: ignore[arg-type]
    if isinstance(value, str) or (isinstance(value, np.ndarray) and value.dtype.kind in "US"):
        return "text"
    if isinstance(value, scipy.io.matlab.MatlabOpaque):
        return MATLAB_OBJECT
    if scipy.sparse.issparse(value):
        return f"a sparse matrix with more than {_MOST_FULL_VALUES:,} values"
    array = np.asarray(value)
    return None if array.dtype.kind in "fiub" else _KINDS.get(array.dtype.kind, "no numbers")


def _chosen(where: str, column: Column, variables: Mapping[str, Any]) -> tuple[object, int | None]:
    """Return a column's variable, and the index of the signal in it if it is a matrix."""
    if not isinstance(column.column, int):
        return _variable(where, column.column, variables), column.index
    matrices = [v for v in list_variables(variables) if len(v.shape) == 2 and min(v.shape) > 1]
    if len(matrices) != 1 or column.index is not None:
        found = ", ".join(v.path for v in matrices[:20]) or "none"
        raise LogError(
            f"{where}: expected a variable's name; a number is a column of the file's only matrix, "
            f"found matrices: {found}; there is {', '.join(variables)}"
        )
    return _variable(where, matrices[0].path, variables), column.column


def _variable(where: str, path: str, variables: Mapping[str, Any]) -> object:
    """Return a variable, a field `name.field`, or an element `name(1).field` of a struct array."""
    if path in variables:
        return variables[path]
    found: object = variables
    for part in path.split("."):
        element = _ELEMENT.fullmatch(part)
        name = element["name"] if element else part
        if isinstance(found, np.ndarray) and name in (found.dtype.names or ()):
            found = found[name]
            continue
        if not isinstance(found, Mapping) or name not in found:
            if any(isinstance(v, scipy.io.matlab.MatlabOpaque) for v in variables.values()):
                # scipy reads neither the names of objects nor their content.
                raise LogError(f"{where}: no such variable; the file holds {MATLAB_OBJECT}")
            known = list(found) if isinstance(found, Mapping) else _paths(found, variables)
            raise LogError(f"{where}: no such variable{_close(part, known)}")
        found = found[name]
        if element is None:
            continue
        index = int(element["index"])
        elements = found if isinstance(found, list) else [found]
        if index > len(elements):
            raise LogError(
                f"{where}: expected an element from {name}(1) to {name}({len(elements)})"
            )
        found = elements[index - 1]
    return found


def _paths(found: object, variables: Mapping[str, Any]) -> list[str]:
    """Return what a part of a path may be where a struct array has no element number."""
    if _is_struct_array(found):
        return [f"({number})" for number in range(1, len(found) + 1)]  # type: ignore[arg-type]
    return list(variables)


def _vector(
    where: str, values: NDArray[np.float64], index: int | None, samples: str
) -> NDArray[np.float64]:
    """Return one signal, (n,), from a vector, or from a matrix by index."""
    if index is None and values.ndim and values.size == max(values.shape):
        return values.ravel()
    # Simulink saves a signal with more dimensions as (width, 1, samples).
    values = np.squeeze(values) if values.ndim > 2 else values
    if values.ndim != 2 or index is None:
        expected = "a vector" if index is not None else "a vector, or an index into a matrix"
        raise LogError(f"{where}: expected {expected}, found shape {values.shape}")
    by_signal: NDArray[np.float64] = values.T if samples == "rows" else values
    if index >= by_signal.shape[0] or by_signal.shape[1] == 1:
        raise LogError(
            f"{where}: expected index 0 to {by_signal.shape[0] - 1} in shape {values.shape} with "
            f"samples along {samples}, found {index}"
        )
    if by_signal.shape[0] > by_signal.shape[1]:
        other = "columns" if samples == "rows" else "rows"
        raise LogError(
            f"{where}: expected more samples than signals, found shape {values.shape} with samples "
            f"along {samples}; set samples: {other}"
        )
    signal: NDArray[np.float64] = by_signal[index]
    return signal


def _close(name: str, known: list[str]) -> str:
    close = difflib.get_close_matches(name, known, n=3) or known[:20]
    return f"; there is {', '.join(close)}" if close else ""
