"""Write CSV files: a header with the names, numbers with all the digits that they have."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from ..log_stream import Block
from .columns import Column

_WIDEST = 24
"""Characters of the longest number: -9223372036854775808 has 20."""


def write_csv(
    path: Path,  # noqa: ARG001 - of messages in other formats
    file: BinaryIO,
    columns: Sequence[Column],
    blocks: Iterable[Block],
    facts: Mapping[str, str],  # noqa: ARG001 - they are in the signals file beside it
) -> int:
    """Write a CSV file with one header line of names; return the number of rows.

    Numbers have the shortest text that gives the same number again; NaN is an empty cell.
    """
    rows = 0
    file.write(",".join(name for c in columns for name in c.flat_names).encode() + b"\n")
    for block in blocks:
        rows += len(block.rows)
        cells = [_texts(part) for column in columns for part in column.flat_values(block)]
        file.writelines(b",".join(row) + b"\n" for row in zip(*cells, strict=True))
    return rows


def _texts(values: NDArray[np.generic]) -> list[bytes]:
    if values.dtype.kind == "b":
        values = values.astype(np.uint8)
    if values.dtype == np.float64:  # repr is the shortest text and ten times as fast as numpy
        texts = [repr(x).encode() for x in values.tolist()]
    else:
        texts = values.astype(f"S{_WIDEST}").tolist()
    if values.dtype.kind == "f":
        for i in np.flatnonzero(np.isnan(np.asarray(values, np.float64))).tolist():
            texts[i] = b""
    return texts
