"""Columns out of a MAT file, read in a process of its own: damage can crash scipy's reader."""

from __future__ import annotations

import io
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np

from .errors import LogError
from .signals_file import SignalsFile
from .tables import Columns, load_mat, read_variables

_REFUSED = 3
"""Exit code of the process for a file that does not fit; what is wrong then stands on stdout."""


def read_mat(path: Path, signals: SignalsFile) -> Columns:
    """Return the columns of a MAT file up to version 7, each (n,), finite.

    Raises:
        LogError: it is no such file, is damaged, or does not hold what `signals` names.
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
            f"{path}: not a usable MAT file: its reader {_end(child.returncode)}, as only damaged "
            "files make it"
        )
    # Numbers alone come back: nothing that a file could have made of the process is believed.
    return list(np.load(io.BytesIO(child.stdout), allow_pickle=False))


def _end(code: int) -> str:
    if code >= 0:
        return f"ended with exit code {code}"
    try:
        return f"was ended by {signal.Signals(-code).name}"
    except ValueError:
        return f"was ended by signal {-code}"


def _read(path: Path) -> int:
    """Write the columns that stdin's signals name to stdout as one array; return the exit code."""
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
