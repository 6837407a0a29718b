"""Read columns from a MAT file in a child process, because damage can crash scipy's reader."""

from __future__ import annotations

import io
import json
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np

from ..errors import LogError
from .array_variables import Columns, Variable, list_variables, load_mat, read_variables
from .signals_yaml import SignalsFile

_REFUSED = 3
"""Exit code of the child process for a file that does not fit; stdout holds the error."""


def read_mat(path: Path, signals: SignalsFile) -> Columns:
    """Return the columns of a MAT file up to version 7, each (n,), NaN where a value is missing.

    Raises:
        LogError: not a MAT file, a damaged one, or one without the columns that `signals` names.
    """
    # Only numbers are accepted: a hostile file may have taken over the child process.
    answer = _child(path, signals.model_dump_json())
    return list(np.load(io.BytesIO(answer), allow_pickle=False))


def list_mat(path: Path) -> list[Variable]:
    """Return the variables of a MAT file up to version 7, structs and their arrays included.

    Raises:
        LogError: not a MAT file, or a damaged one.
    """
    return [
        Variable(str(name), tuple(map(int, shape)), content, value)
        for name, shape, content, value in json.loads(_child(path, ""))
    ]


def _child(path: Path, request: str) -> bytes:
    """Return the answer of the child process to a SignalsFile, or to an empty request."""
    child = subprocess.run(
        [sys.executable, "-P", "-m", __name__, str(path)],
        input=request.encode(),
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
    return child.stdout


def _end(code: int) -> str:
    if code >= 0:
        return f"ended with exit code {code}"
    try:
        return f"was ended by {signal.Signals(-code).name}"
    except ValueError:
        return f"was ended by signal {-code}"


def _answer(path: Path) -> int:
    """Write the columns, or the variables as JSON, to stdout; return the exit code.

    stdin: the SignalsFile, or nothing for a list of the variables.
    """
    request = sys.stdin.buffer.read()
    try:
        variables = load_mat(path)
        if not request:
            found = [[v.path, v.shape, v.content, v.value] for v in list_variables(variables)]
            sys.stdout.buffer.write(json.dumps(found).encode())
            return 0
        columns = read_variables(path, SignalsFile.model_validate_json(request), variables)
    except LogError as error:
        sys.stdout.buffer.write(str(error).encode())
        return _REFUSED
    np.save(sys.stdout.buffer, np.stack(columns), allow_pickle=False)
    return 0


if __name__ == "__main__":
    sys.exit(_answer(Path(sys.argv[1])))
