"""Read columns from a MAT file in a child process, because damage can crash scipy's reader.

The child has memory and processor time in proportion to the file, and ends with its parent.
"""

from __future__ import annotations

import ctypes
import io
import json
import os
import resource
import signal
import subprocess
import sys
from pathlib import Path
from typing import IO

import numpy as np

from ..errors import LogError
from ..unpacked_size import most_unpacked_bytes
from .array_variables import Columns, Variable, list_variables, load_mat, read_variables
from .signals_yaml import SignalsFile

_REFUSED = 3
"""Exit code of the child process for a file that does not fit; stdout holds the error."""
_COPIES = 3
"""Memory of the child over the size of an unpacked file: the variables, their columns, and the
array in which these are sent."""
_CPU_S, _BYTES_PER_S = 20, 2 << 20
"""Processor time of the child for any file, and bytes of the file for each further second."""
_TOO_LARGE = (
    "expected a MAT file that unpacks into memory in proportion to its size, found one that takes "
    "more: damaged, or made of repeated values; if it is right, save it with '-v6', uncompressed"
)
_PR_SET_PDEATHSIG = 1


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
        [sys.executable, "-P", "-m", __name__, str(path), str(os.getpid())],
        input=request.encode(),
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        check=False,
        env={**os.environ, "OPENBLAS_NUM_THREADS": "1"},  # threads take address space
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


def _main(path: Path, parent: int) -> int:
    """Write the answer to the request on stdin to stdout; return the exit code."""
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0)
    if os.getppid() != parent:
        return 1  # it ended before
    request = sys.stdin.buffer.read()  # ends early if the parent has ended already
    try:
        _limit(path)
        _answer(path, request.decode(), sys.stdout.buffer)
    except LogError as error:
        sys.stdout.buffer.write(str(error).encode())
        return _REFUSED
    except MemoryError:
        sys.stdout.buffer.write(f"{path}: {_TOO_LARGE}".encode())
        return _REFUSED
    return 0


def _answer(path: Path, request: str, out: IO[bytes]) -> None:
    """Write the columns that a SignalsFile requests; the variables as JSON without a request."""
    variables = load_mat(path)
    if request:
        columns = read_variables(path, SignalsFile.model_validate_json(request), variables)
        np.save(out, np.stack(columns), allow_pickle=False)
    else:
        found = [[v.path, v.shape, v.content, v.value] for v in list_variables(variables)]
        out.write(json.dumps(found).encode())


def _limit(path: Path) -> None:
    """Limit memory and processor time of this process; what was imported counts as well."""
    try:
        size = path.stat().st_size
    except OSError as error:
        raise LogError(f"{path}: cannot be read: {error.strerror}") from None
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    _lower(resource.RLIMIT_AS, pages * resource.getpagesize() + _COPIES * most_unpacked_bytes(size))
    _lower(resource.RLIMIT_CPU, _CPU_S + size // _BYTES_PER_S)
    _lower(resource.RLIMIT_CORE, 0)


def _lower(what: int, limit: int) -> None:
    hard = resource.getrlimit(what)[1]
    limit = limit if hard == resource.RLIM_INFINITY else min(limit, hard)
    resource.setrlimit(what, (limit, limit))


if __name__ == "__main__":
    sys.exit(_main(Path(sys.argv[1]), int(sys.argv[2])))
