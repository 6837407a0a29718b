"""Write MAT files of level 5 for MATLAB and Octave, larger than the memory if need be.

scipy.io.savemat needs each variable in memory. Here it writes the small ones (units, metadata); the
columns are appended as the format states it: MathWorks, MAT-File Format, level 5.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from struct import Struct
from typing import Any, BinaryIO, cast

from ..errors import LogError
from ..log_stream import Block
from .columns import Column
from .spool import Spool

_TAG = Struct("<II")
_MATRIX, _INT32, _UINT32, _INT8 = 14, 5, 6, 1
# Array class and data type by numpy type; MATLAB's logical is uint8 with a flag.
_TYPES = {
    "f8": (6, 9),
    "f4": (7, 7),
    "i1": (8, 1),
    "u1": (9, 2),
    "i2": (10, 3),
    "u2": (11, 4),
    "i4": (12, 5),
    "u4": (13, 6),
    "i8": (14, 12),
    "u8": (15, 13),
    "b1": (9, 2),
}
_LOGICAL = 1 << 9
_MOST_BYTES = (1 << 31) - (1 << 10)
"""Largest variable that MATLAB reads from a file of this level."""


def write_mat(
    path: Path,
    file: BinaryIO,
    columns: Sequence[Column],
    blocks: Iterable[Block],
    facts: Mapping[str, str],
) -> int:
    """Write a MAT file, which will be `path`; return the number of rows.

    Each column is a variable (n, 1) or (n, length) of the log's type; `units` and `metadata` are
    structs of text.

    Raises:
        LogError: a variable would be larger than 2 GiB, which the format does not allow.
    """
    from scipy.io import savemat

    rows = 0
    with Spool(path.parent) as spool:
        for block in blocks:
            rows += len(block.rows)
            for column in columns:
                for name, part in zip(column.flat_names, column.flat_values(block), strict=True):
                    spool.append(f"{column.name} {name}", part)
        texts = {
            "units": {c.name: c.unit for c in columns},
            "metadata": dict(facts),
        }
        savemat(cast("Any", file), texts, appendmat=False, long_field_names=True)
        for column in columns:
            _append_matrix(file, path, column, rows, spool)
    return rows


def _append_matrix(file: BinaryIO, path: Path, column: Column, rows: int, spool: Spool) -> None:
    array_class, data_type = _TYPES[column.dtype.str[1:]]
    flags = array_class | (_LOGICAL if column.dtype.kind == "b" else 0)
    width = 1 if column.length is None else column.length
    size = rows * width * column.dtype.itemsize
    if size > _MOST_BYTES:
        raise LogError(
            f"{path}: {column.name}: expected at most 2 GiB in a variable of a MAT file, found "
            f"{size / 2**30:.3g} GiB: export a part (--begin-s, --end-s), every N-th row "
            "(--every), or NPZ or Parquet"
        )
    head = b"".join(
        (
            _TAG.pack(_UINT32, 8) + _TAG.pack(flags, 0),
            _TAG.pack(_INT32, 8) + _TAG.pack(rows, width),
            _element(_INT8, column.name.encode()),
            _TAG.pack(data_type, size),
        )
    )
    padding = b"\0" * (-size % 8)
    file.write(_TAG.pack(_MATRIX, len(head) + size + len(padding)) + head)
    for name in column.flat_names:
        spool.copy(f"{column.name} {name}", file)
    file.write(padding)


def _element(kind: int, data: bytes) -> bytes:
    return _TAG.pack(kind, len(data)) + data + b"\0" * (-len(data) % 8)
