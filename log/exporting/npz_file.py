"""Write NPZ files: one array a field, with units and metadata as arrays of text."""

from __future__ import annotations

import io
import zipfile
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import BinaryIO, cast

import numpy as np

from ..log_stream import Block
from .columns import Column
from .spool import Spool


def write_npz(
    path: Path,
    file: BinaryIO,
    columns: Sequence[Column],
    blocks: Iterable[Block],
    facts: Mapping[str, str],
) -> int:
    """Write an uncompressed NPZ file, which will be `path`; return the number of rows.

    Each column is an array (n,) or (n, length) of the log's type. `units` (k, 2) holds pairs of
    column and unit, `metadata` (k, 2) pairs of text: `dict(numpy.load(path)["units"])`.
    """
    rows = 0
    with Spool(path.parent) as spool, zipfile.ZipFile(file, "w", allowZip64=True) as archive:
        for block in blocks:
            rows += len(block.rows)
            for column in columns:
                spool.append(column.name, column.values(block))
        for column in columns:
            shape = (rows,) if column.length is None else (rows, column.length)
            with archive.open(f"{column.name}.npy", "w", force_zip64=True) as member:
                header = {
                    "descr": np.lib.format.dtype_to_descr(column.dtype),
                    "fortran_order": False,
                    "shape": shape,
                }
                np.lib.format.write_array_header_2_0(member, header)
                spool.copy(column.name, cast("BinaryIO", member))
        for name, pairs in (
            ("units", [(c.name, c.unit) for c in columns]),
            ("metadata", list(facts.items())),
        ):
            text = io.BytesIO()
            np.lib.format.write_array(text, np.array(pairs, dtype=np.str_).reshape(-1, 2))
            archive.writestr(f"{name}.npy", text.getvalue())
    return rows
