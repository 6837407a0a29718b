"""Keep compiled functions in files: checked before they are loaded, compiled again if damaged.

numba's own cache loads any pickle that it finds: an empty, cut or altered file raises an unpickling
error in flight, and whoever can write the file runs code as this user. Each file of this cache
begins with a SHA-256 of its content and of all that the code depends on; it and its folder belong
to this user alone.
"""

from __future__ import annotations

import enum
import hashlib
import os
import pickle
import platform
import secrets
import sys
from collections.abc import Iterator
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any

import numba
import numpy as np
from numba.core.caching import _Cache
from numba.core.compiler import CompileResult
from numba.core.dispatcher import Dispatcher
from numba.core.serialize import dumps

from .private_files import is_private_folder, make_private_folder, read_private
from .user_folders import absolute_folder, temporary_folder, xdg_folder

_VERSIONS = (platform.python_version(), numba.__version__, np.__version__)
_OPTIMISED = sys.flags.optimize
"""python -O has other code: in files of its own, or the two would replace each other's."""
_rebuild: Any = CompileResult._rebuild
_dumps: Any = dumps
_SUFFIX = ".compiled"
_CONSTANTS = (int, float, complex, str, bytes, tuple, np.generic, np.dtype)


@cache
def cache_folder() -> Path | None:
    """Return the folder of compiled functions; None if no folder can be private and written.

    The first of $NUMBA_CACHE_DIR, $XDG_CACHE_HOME or ~/.cache, and /tmp in which this user has a
    private folder; one that cannot be written to is read. A relative path does not count: it would
    name the working directory.
    """
    bases = (
        absolute_folder(os.environ.get("NUMBA_CACHE_DIR")),
        xdg_folder("XDG_CACHE_HOME", ".cache"),
    )
    folders = [base / "levid" / f"compiled-{os.geteuid()}" for base in bases if base is not None]
    temporary = temporary_folder()
    if make_private_folder(temporary):
        folders.append(temporary / "compiled")
    return next((f for f in folders if make_private_folder(f) or is_private_folder(f)), None)


class CheckedCache(_Cache):
    """The cache of one function, in place of numba's FunctionCache."""

    def __init__(self, py_func: Any) -> None:
        self._py_func = py_func
        self._enabled = True
        self._stamp: str | None = None

    @property
    def cache_path(self) -> str | None:
        """Folder of the cache, None without one."""
        folder = cache_folder()
        return None if folder is None else str(folder)

    def enable(self) -> None:
        """Use the cache from now on."""
        self._enabled = True

    def disable(self) -> None:
        """Neither load nor save from now on."""
        self._enabled = False

    def flush(self) -> None:
        """Do nothing: a file of other sources is never loaded, and is replaced."""

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """Return the compiled function for a signature; None if it must be compiled.

        A file that is damaged, or that this user does not own alone, is deleted.
        """
        target_context.refresh()
        place = self._place(sig, target_context.codegen())
        if place is None:
            return None
        path, key = place
        try:
            content = read_private(path)
            digest, data = content[:32], content[32:]
            if digest != _digest(key, data):
                raise ValueError("damaged, or of other sources")
            return _rebuild(target_context, *pickle.loads(data))
        except FileNotFoundError:
            return None
        except Exception:  # noqa: BLE001 - whatever is wrong with a file: compile again
            with suppress(OSError):
                path.unlink()
            return None

    def save_overload(self, sig: Any, data: Any) -> None:
        """Save a compiled function; a full disk only costs the next process its time."""
        place = self._place(sig, data.codegen)
        cacheable = not data.library.has_dynamic_globals and all(x.can_cache for x in data.lifted)
        if place is None or not cacheable:
            return
        path, key = place
        content: bytes = _dumps(data._reduce())
        temporary = path.with_name(f"{secrets.token_hex(8)}.tmp")
        try:
            flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC
            with os.fdopen(os.open(temporary, flags, 0o600), "wb") as file:
                file.write(_digest(key, content) + content)
            temporary.replace(path)
        except OSError:
            with suppress(OSError):
                temporary.unlink()

    def _place(self, sig: Any, codegen: Any) -> tuple[Path, bytes] | None:
        """Return the file of a signature, and all that its content depends on."""
        folder = cache_folder() if self._enabled else None
        signature = str(sig)
        if folder is None or " at 0x" in signature:  # an address means nothing elsewhere
            return None
        if self._stamp is None:
            self._stamp = source_stamp(self._py_func)
        code = self._py_func.__code__
        name = f"{self._py_func.__module__}.{self._py_func.__qualname__}"
        closure = _closure(self._py_func)
        place = name, code.co_filename, closure, signature, codegen.magic_tuple()
        where = repr((*place, _OPTIMISED))
        file = f"{name.rpartition('.')[2]}-{hashlib.sha256(where.encode()).hexdigest()[:24]}"
        return folder / f"{file}{_SUFFIX}", repr((where, self._stamp, _VERSIONS)).encode()


def source_stamp(py_func: Any) -> str:
    """Return a digest of the sources and constants that a function is compiled from.

    They are its source file, the source files of the compiled functions that it calls, and the
    values of the global constants that any of them uses.
    """
    digest = hashlib.sha256()
    for part in _parts(py_func, set()):
        digest.update(hashlib.sha256(part).digest())
    return digest.hexdigest()


def _parts(py_func: Any, seen: set[Any]) -> Iterator[bytes]:
    if py_func in seen:
        return
    seen.add(py_func)
    code = py_func.__code__
    if code.co_filename not in seen:
        seen.add(code.co_filename)
        with suppress(OSError):
            yield Path(code.co_filename).read_bytes()
    yield code.co_code
    for cell in py_func.__closure__ or ():
        yield from _value_parts("", cell.cell_contents, seen)
    for name in sorted(_names(code)):
        if name in py_func.__globals__:
            yield from _value_parts(name, py_func.__globals__[name], seen)


def _value_parts(name: str, value: Any, seen: set[Any]) -> Iterator[bytes]:
    if isinstance(value, Dispatcher):
        yield from _parts(value.py_func, seen)
    elif isinstance(value, np.ndarray):
        yield f"{name}={value.dtype.str}{value.shape}".encode() + value.tobytes()
    elif isinstance(value, _CONSTANTS):
        yield f"{name}={value!r}".encode()
    elif isinstance(value, enum.EnumMeta):
        yield f"{name}={list(value)!r}".encode()


def _closure(py_func: Any) -> list[str]:
    """Return digests of the values that a function takes from the one that defines it.

    Functions that one definition makes for several values each have files of their own.
    """
    cells = [cell.cell_contents for cell in py_func.__closure__ or ()]
    return [
        hashlib.sha256(b"" if isinstance(value, Dispatcher) else _dumps(value)).hexdigest()
        for value in cells
    ]


def _names(code: Any) -> set[str]:
    """Return the global names that a code object and those inside it use."""
    names = set(code.co_names)
    for constant in code.co_consts:
        if hasattr(constant, "co_names"):
            names |= _names(constant)
    return names


def _digest(key: bytes, data: bytes) -> bytes:
    return hashlib.sha256(hashlib.sha256(key).digest() + data).digest()
