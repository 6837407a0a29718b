"""Name the formats of data files by their suffix; imports nothing, so that completion is fast."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from .signals_yaml import Format

FORMAT_OF_SUFFIX: dict[str, Format] = {
    ".csv": "csv",
    ".txt": "text",
    ".dat": "text",
    ".asc": "text",
    ".npz": "npz",
    ".npy": "npz",
    ".mat": "mat",
}
