"""Collect columns in temporary files, because MAT and NPZ store one column after another."""

from __future__ import annotations

import shutil
import tempfile
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType
from typing import BinaryIO, Self, cast

import numpy as np
from numpy.typing import NDArray

_COPY_BYTES = 1 << 20


class Spool:
    """One file a column, without a name: the kernel deletes it with the process at the latest."""

    def __init__(self, beside: Path) -> None:
        self._beside = beside
        self._files: dict[str, BinaryIO] = {}
        self._open = ExitStack()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._open.close()

    def append(self, name: str, values: NDArray[np.generic]) -> None:
        """Append values to a column, in C order."""
        if name not in self._files:
            file = tempfile.TemporaryFile(dir=self._beside)  # noqa: SIM115 - closed by _open
            self._files[name] = cast("BinaryIO", self._open.enter_context(file))
        self._files[name].write(np.ascontiguousarray(values).data.cast("B"))

    def copy(self, name: str, out: BinaryIO) -> None:
        """Append a column's bytes to `out`."""
        file = self._files[name]
        file.seek(0)
        shutil.copyfileobj(file, out, _COPY_BYTES)
