"""Collect columns in temporary files, because MAT and NPZ store one column after another."""

from __future__ import annotations

import shutil
import tempfile
from pathlib import Path
from types import TracebackType
from typing import BinaryIO, Self

import numpy as np
from numpy.typing import NDArray

_COPY_BYTES = 1 << 20


class Spool:
    """A folder with one file a column, deleted at the end of the `with` body."""

    def __init__(self, beside: Path) -> None:
        self._folder = tempfile.TemporaryDirectory(prefix=".levid-export-", dir=beside)
        self._files: dict[str, BinaryIO] = {}

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        for file in self._files.values():
            file.close()
        self._folder.cleanup()

    def append(self, name: str, values: NDArray[np.generic]) -> None:
        """Append values to a column, in C order."""
        if name not in self._files:
            path = Path(self._folder.name, str(len(self._files)))
            self._files[name] = path.open("w+b")
        self._files[name].write(np.ascontiguousarray(values).data.cast("B"))

    def copy(self, name: str, out: BinaryIO) -> None:
        """Append a column's bytes to `out`."""
        file = self._files[name]
        file.seek(0)
        shutil.copyfileobj(file, out, _COPY_BYTES)
