"""Read columns from a MAT file in a child process, because damage can crash scipy's reader."""

from __future__ import annotations

import io
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np

from .errors import LogError
from .signals_yaml import SignalsFile
from .tabular_files import Columns, load_mat, read_variables

_REFUSED = 3
"""Exit code of the child process for a file that does not fit; stdout holds the error."""


def read_mat(path: Path, signals: SignalsFile) -> Columns:
    """Return the columns of a MAT file up to version 7, each (n,), finite.

    Raises:
        LogError: not a MAT file, a damaged one, or one without the columns that `signals` names.
    """
    child = subprocess.run(
        [sys.executable, "-P", "-m", __name__, str(path)],
        input=signals.model_dump_json().encode(),
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        check=False,
    )
    if child.returncode == _REFUSED:
        raise LogError(child.stdout.decode())
    if child.returncode != 0:
        raise LogError(
            f"{path}: not a usable MAT file: its reader {_end(child.returncode)}, which only a "
            "damaged file causes"
        )
    # Only numbers are accepted: a hostile file may have taken over the child process.
    return list(np.load(io.BytesIO(child.stdout), allow_pickle=False))


def _end(code: int) -> str:
    if code >= 0:
        return f"ended with exit code {code}"
    try:
        return f"was ended by {signal.Signals(-code).name}"
    except ValueError:
        return f"was ended by signal {-code}"


def _read(path: Path) -> int:
    """Write the columns to stdout as one array (stdin: the SignalsFile); return the exit code."""
    signals = SignalsFile.model_validate_json(sys.stdin.buffer.read())
    try:
        columns = read_variables(path, signals, load_mat(path))
    except LogError as error:
        sys.stdout.buffer.write(str(error).encode())
        return _REFUSED
    np.save(sys.stdout.buffer, np.stack(columns), allow_pickle=False)
    return 0


if __name__ == "__main__":
    sys.exit(_read(Path(sys.argv[1])))
