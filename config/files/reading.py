"""Open files for reading: a pipe, socket or device in place of a file makes no reader wait.

JSON has the limits that YAML has (config.base): the size of the text, the levels of its lists and
objects, and numbers that are finite.
"""

from __future__ import annotations

import errno
import json
import math
import os
import stat
from pathlib import Path
from typing import Any, BinaryIO, cast

MOST_LEVELS = 64
"""Most levels of lists and objects in JSON; results have 8."""
MOST_JSON_BYTES = 64 << 20
"""Largest JSON file; a result with all its curves has some hundred KiB."""
_KINDS = {
    stat.S_IFDIR: "a folder",
    stat.S_IFIFO: "a pipe",
    stat.S_IFSOCK: "a socket",
    stat.S_IFCHR: "a device",
    stat.S_IFBLK: "a device",
}


class JsonError(ValueError):
    """A text is not JSON, or exceeds a limit; the message says what was expected."""


def kind_of(path: Path | str) -> str:
    """Return in words what is at a path: "a file", "a folder", "a pipe", ..., or "none"."""
    try:
        return _kind(Path(path).stat().st_mode)
    except (OSError, ValueError):
        return "a link to a missing path" if Path(path).is_symlink() else "none"


def open_file(path: Path | str) -> BinaryIO:
    """Open a regular file for reading.

    Raises:
        OSError: it cannot be read, or is not a regular file: a folder, pipe, socket or device.
    """
    try:
        # A pipe that nobody writes to would wait to be opened.
        descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    except OSError as error:
        if error.errno == errno.ENXIO:  # a socket
            raise _no_file(path, kind_of(path)) from None
        raise
    found = os.fstat(descriptor).st_mode
    if not stat.S_ISREG(found):
        os.close(descriptor)
        raise _no_file(path, _kind(found))
    return cast("BinaryIO", os.fdopen(descriptor, "rb"))


def read_json(path: Path | str, most_bytes: int = MOST_JSON_BYTES) -> Any:
    """Return the data of a JSON file. Raises OSError, JsonError."""
    with open_file(path) as file:
        return parse_json(file.read(most_bytes + 1), most_bytes)


def parse_json(text: str | bytes, most_bytes: int = MOST_JSON_BYTES) -> Any:
    """Return the data of a JSON text; raises JsonError."""
    if len(text) > most_bytes:
        raise JsonError(f"expected at most {most_bytes} bytes of JSON, found more")
    try:
        data = json.loads(text, parse_constant=_no_number, parse_float=_finite)
    except JsonError:
        raise
    except RecursionError:
        raise JsonError(_too_deep()) from None
    except UnicodeDecodeError:
        raise JsonError("expected text in UTF-8") from None
    except json.JSONDecodeError as error:
        raise JsonError(f"not valid JSON: line {error.lineno}, column {error.colno}") from None
    except ValueError:  # Python's limit on the digits of an integer
        raise JsonError("expected numbers of some digits, found one of thousands") from None
    _check_levels(data)
    return data


def _check_levels(data: object) -> None:
    level = [data]
    for _ in range(MOST_LEVELS):
        inner: list[object] = []
        for value in level:
            if isinstance(value, dict):
                inner += [v for v in value.values() if isinstance(v, (dict, list))]
            elif isinstance(value, list):
                inner += [v for v in value if isinstance(v, (dict, list))]
        if not inner:
            return
        level = inner
    raise JsonError(_too_deep())


def _too_deep() -> str:
    return f"expected at most {MOST_LEVELS} levels of lists and objects, found more"


def _no_number(name: str) -> float:
    raise JsonError(f"expected finite numbers or null, found {name}")


def _finite(text: str) -> float:
    value = float(text)
    if not math.isfinite(value):
        raise JsonError(f"expected finite numbers, found {text[:40]}")
    return value


def _kind(mode: int) -> str:
    return _KINDS.get(stat.S_IFMT(mode), "a file")


def _no_file(path: Path | str, found: str) -> OSError:
    number = errno.EISDIR if found == "a folder" else errno.EINVAL
    return OSError(number, f"expected a file, found {found}", str(path))
