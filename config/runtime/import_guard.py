"""Import numba and matplotlib without the files that they read from the working directory.

numba reads `.numba_config.yaml` there, which names the folder of compiled code; matplotlib reads
`matplotlibrc`, which names a module to import. A folder of measured data, often somebody else's,
must not decide what code runs. levid installs this guard before it imports anything else.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from importlib.machinery import ModuleSpec, PathFinder
from pathlib import Path
from types import ModuleType
from typing import Any

_NO_FILE = "/dev/null/none"


def install() -> None:
    """Guard the imports of this process; does nothing the second time."""
    if any(isinstance(finder, _Finder) for finder in sys.meta_path):
        return
    sys.meta_path.insert(0, _Finder())
    if "numba" in sys.modules:  # imported by a notebook, for example
        _check_compiled_code()


class OwnProcess:
    """Whether this process is a command of levid, not somebody's Python that imports it."""

    value = False


@contextmanager
def _numba() -> Iterator[None]:
    with _hidden(".numba_config.yaml"):
        yield
    _check_compiled_code()


def _check_compiled_code() -> None:
    """Load and save compiled functions through the checked cache only."""
    import numba.core.config

    # numba reads it again before each compilation.
    numba.core.config._config_fname = _NO_FILE
    for name, module in list(sys.modules.items()):
        if name.startswith("numba.") and hasattr(module, "FunctionCache"):
            vars(module)["FunctionCache"] = _checked_cache


def _checked_cache(function: object) -> object:
    from .compile_cache import CheckedCache  # imports numba itself

    return CheckedCache(function)


@contextmanager
def _matplotlib() -> Iterator[None]:
    """In a command, figures look as levid draws them: the user's settings may even fail."""
    if not OwnProcess.value:
        yield
        return
    folder = Path(sys.modules["matplotlib"].__file__ or "").parent
    os.environ.pop("MPLBACKEND", None)
    os.environ["MATPLOTLIBRC"] = str(folder / "mpl-data" / "matplotlibrc")
    with _hidden("matplotlibrc"):
        yield


@contextmanager
def _hidden(name: str) -> Iterator[None]:
    """Let a file of this name in the working directory not exist, for os.path.exists."""
    exists = os.path.exists

    def exists_elsewhere(path: object) -> bool:
        return path != name and exists(path)  # type: ignore[arg-type]

    os.path.exists = exists_elsewhere
    try:
        yield
    finally:
        os.path.exists = exists


_GUARDS: dict[str, Callable[[], AbstractContextManager[None]]] = {
    "numba": _numba,
    "matplotlib": _matplotlib,
}


class _Finder:
    def find_spec(
        self, name: str, path: Sequence[str] | None = None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        if name not in _GUARDS:
            return None
        spec = PathFinder.find_spec(name, path, target)
        if spec is not None and spec.loader is not None:
            guarded: Any = _GuardedLoader(spec.loader, _GUARDS[name])
            spec.loader = guarded
        return spec


class _GuardedLoader:
    """Execute one module inside its guard; afterwards the module has its original loader."""

    def __init__(self, loader: Any, guard: Callable[[], AbstractContextManager[None]]) -> None:
        self._loader, self._guard = loader, guard

    def create_module(self, spec: ModuleSpec) -> ModuleType | None:
        created: ModuleType | None = self._loader.create_module(spec)
        return created

    def exec_module(self, module: ModuleType) -> None:
        module.__loader__ = self._loader
        if module.__spec__ is not None:
            module.__spec__.loader = self._loader
        with self._guard():
            self._loader.exec_module(module)
