"""Import files of measured data into a temporary folder."""

from __future__ import annotations

import tempfile
import warnings
from collections.abc import Sequence
from pathlib import Path

from ..log.importing.importer import import_file


def imported_logs(
    files: Sequence[Path], signals: Path
) -> tuple[list[Path], tempfile.TemporaryDirectory[str]]:
    """Return logs of the data files, and the folder that holds them.

    Likely mistakes in `signals` are warnings.

    Raises:
        ConfigError: `signals` is not a valid SIGNALS.yaml.
        LogError: the data do not fit it.
    """
    folder = tempfile.TemporaryDirectory(prefix="levid-")
    logs: list[Path] = []
    for number, file in enumerate(files):
        own = Path(folder.name) / str(number)
        own.mkdir()
        found = import_file(file, signals, own / f"{file.stem}.mcap")
        logs += [path for path, _ in found.logs]
        for warning in found.warnings:
            warnings.warn(warning, stacklevel=3)
    return logs, folder
