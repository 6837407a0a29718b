"""Files of benchmarks/ for tests of them: it is no package, and they find each other by path."""

from __future__ import annotations

import importlib
import importlib.util
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType

BENCHMARKS = Path(__file__).parents[1] / "benchmarks"


def module(name: str) -> ModuleType:
    """Return what benchmarks share, `_table` and the like: the one module that they import too."""
    with _on_path():
        return importlib.import_module(name)


def script(name: str) -> ModuleType:
    """Return a benchmark, under a name of its own: `trace` is the standard library's as well."""
    spec = importlib.util.spec_from_file_location(f"benchmark_{name}", BENCHMARKS / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    found = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = found  # where its dataclasses look for it
    with _on_path():
        spec.loader.exec_module(found)
    return found


@contextmanager
def _on_path() -> Iterator[None]:
    sys.path.insert(0, str(BENCHMARKS))
    try:
        yield
    finally:
        sys.path.remove(str(BENCHMARKS))
