"""A digest of code and settings: results that are kept on disk hold only for what made them."""

from __future__ import annotations

import ast
import hashlib
import io
import json
import tokenize
from collections.abc import Iterable, Iterator
from pathlib import Path

import levid
from levid.config.base import read_mapping

ROOT = Path(levid.__file__).parent
FLYING = ("daemon/loop/virtual_session.py", "drivers/loopback.py", "sim/effects")
"""What decides how a plant flies in virtual time, with all that it imports."""
_ELSEWHERE = ("wire",)
"""Packages that are imported there and have no part in it: buses."""


def code_version(
    roots: Iterable[str], sources: Iterable[Path] = (), settings: Iterable[Path] = ()
) -> str:
    """Return a digest of the code that roots are and import, of sources and of settings.

    `roots` are modules or folders of the package. Comments and docstrings do not count, nor, of
    settings, which are YAML files, the order of keys.
    """
    digest = hashlib.sha256()
    for path in (*needed(roots), *sources):
        digest.update(bare(path.read_text(encoding="utf-8")).encode())
    for path in settings:
        digest.update(canonical(read_mapping(path)).encode())
    return digest.hexdigest()[:12]


def needed(roots: Iterable[str]) -> list[Path]:
    """Return the modules of the package that roots are, or import, wherever in them they do so."""
    waiting = [path for root in roots for path in _modules(ROOT / root)]
    found: set[Path] = set()
    while waiting:
        path = waiting.pop()
        if path not in found and path.relative_to(ROOT).parts[0] not in _ELSEWHERE:
            found.add(path)
            waiting += _imported(path)
    return sorted(found)


def bare(source: str) -> str:
    """Return a module's lines without comments, strings that stand alone, and empty lines.

    What is left is text, not a tree: the same for every version of Python.
    """
    lines = source.splitlines()
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type == tokenize.COMMENT:
            row, column = token.start
            lines[row - 1] = lines[row - 1][:column]
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant):
            first, last = node.lineno - 1, node.end_lineno or node.lineno
            if isinstance(node.value.value, str) and not lines[first][: node.col_offset].strip():
                lines[first:last] = [""] * (last - first)
    return "\n".join(line.rstrip() for line in lines if line.strip())


def canonical(value: object) -> str:
    """Return the text of plain data that does not depend on comments or on the order of keys."""
    return json.dumps(value, sort_keys=True)


def _modules(path: Path) -> list[Path]:
    return sorted(path.rglob("*.py")) if path.is_dir() else [path]


def _imported(path: Path) -> Iterator[Path]:
    """Yield the modules that a module imports by relative imports, the project's only kind."""
    package = path.parent.relative_to(ROOT).parts
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if not isinstance(node, ast.ImportFrom) or not node.level:
            continue
        base = package[: len(package) - node.level + 1]
        module = ROOT.joinpath(*base, *(node.module or "").split("."))
        for one in (module, *(module / name.name for name in node.names)):
            yield from (p for p in (one.with_suffix(".py"), one / "__init__.py") if p.exists())
